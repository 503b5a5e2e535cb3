"""HTML and SVG as values: text is escaped unless it is markup already, so no caller has to think of it."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence

VOID = ("br", "hr", "img", "input", "meta")
# Not allowed in HTML or XML, or not to be written as UTF-8: names of files may hold all of them.
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


class Html(str):
    """Markup, which is not escaped again."""

    __slots__ = ()


def tag(name: str, *children: str, **attributes: object) -> Html:
    """An element.

    Args:
        name: of the element.
        children: what stands in it; plain strings are escaped.
        attributes: `class_` is class and `stroke_width` is stroke-width; numbers are rounded; None and False are left
            out.
    """
    said = "".join(f' {_key(key)}="{_value(value)}"' for key, value in attributes.items() if not _absent(value))
    if name in VOID:
        return Html(f"<{name}{said}>")
    return Html(f"<{name}{said}>{joined(children)}</{name}>")


def joined(parts: Sequence[str]) -> Html:
    """One after the other; plain strings are escaped."""
    return Html("".join(part if isinstance(part, Html) else escaped(part) for part in parts))


def escaped(text: str) -> Html:
    """Plain text as markup."""
    return Html(html.escape(UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", text), quote=True))


def _key(name: str) -> str:
    return name.rstrip("_").replace("_", "-")


def _absent(value: object) -> bool:
    return value is None or value is False


def _value(value: object) -> str:
    if value is True:
        return ""
    return escaped(f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value))
