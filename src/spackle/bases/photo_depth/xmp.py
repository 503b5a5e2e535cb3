"""XMP of a stranger's file as a small tree: no document types, no entities, bounded in size and depth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import NoReturn
from xml.parsers import expat

from spackle.bases.photo_depth.coded import BrokenDepth
from spackle.errors import reason_in_a_line

MAX_NODES = 20_000
MAX_DEPTH = 64
RDF_ITEM = "http://www.w3.org/1999/02/22-rdf-syntax-ns# li"


@dataclasses.dataclass
class Node:
    """An element. Names are "namespace local"; a property is an attribute or a child element."""

    name: str
    attributes: dict[str, str]
    children: list[Node] = dataclasses.field(default_factory=list)
    texts: list[str] = dataclasses.field(default_factory=list)

    def walk(self) -> Iterator[Node]:
        """Itself and everything below, in the document's order."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting.extend(reversed(node.children))

    def get(self, name: str) -> str | None:
        """A property of this very element."""
        if name in self.attributes:
            return self.attributes[name].strip()
        found = next((child for child in self.children if child.name == name), None)
        return None if found is None else "".join(found.texts).strip()

    def find(self, name: str) -> str | None:
        """A property of this element or the first one below that has it."""
        return next((value for node in self.walk() if (value := node.get(name)) is not None), None)

    def number(self, name: str) -> float | None:
        """A property of this element or one below as a finite number; BrokenDepth where it is something else."""
        text = self.find(name)
        return None if text is None else to_number(text, name)

    def numbers(self, name: str) -> list[float]:
        """A list property, wherever it is; empty where it is missing or holds something else."""
        lists = (node for node in self.walk() if node.name == name)
        entries = [entry for found in lists for entry in found.walk() if entry.name == RDF_ITEM]
        try:
            return [float("".join(entry.texts)) for entry in entries]
        except ValueError:
            return []


def to_number(text: str, name: str) -> float:
    """A finite number; BrokenDepth with the property's name otherwise."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BrokenDepth(f"has {text[:40]!r} for {name.rpartition(' ')[2]}, which is no number")
    return value


def parse_xmp(packet: bytes) -> Node:
    """The tree under one root; BrokenDepth where the text is no XML, or hostile."""
    root = Node("", {})
    open_nodes, count = [root], 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_NODES or len(open_nodes) > MAX_DEPTH:
            raise BrokenDepth("is described by XMP that is too large or too deep")
        node = Node(name, attributes)
        open_nodes[-1].children.append(node)
        open_nodes.append(node)

    def refuse(*_: object) -> NoReturn:
        raise BrokenDepth("is described by XMP with a document type, which is not read")

    parser = expat.ParserCreate(namespace_separator=" ")
    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_nodes.pop()
    parser.CharacterDataHandler = lambda text: open_nodes[-1].texts.append(text)
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(packet.strip(b"\0"), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two: an encoding that is none
        raise BrokenDepth(f"is described by XMP that cannot be read ({reason_in_a_line(error)})") from error
    return root
