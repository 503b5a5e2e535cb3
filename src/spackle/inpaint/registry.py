"""The table of inpainters. To add one: write its class in a file of this room, and add a line here.

An inpainter that lies outside of Spackle needs no line: its name is `package.module:Class`.
"""

from __future__ import annotations

from spackle.inpaint.lama import LamaInpainter
from spackle.inpaint.plain import ExemplarInpainter, OpencvInpainter
from spackle.inpaint.propainter import PropainterInpainter
from spackle.inpaint.protocol import Inpainter, InpainterOptions
from spackle.runtime.errors import check_name
from spackle.runtime.plugins import load_plugin

# Packages such as OpenCV are imported only when one of these classes is called.
INPAINTERS: dict[str, type[Inpainter]] = {
    "exemplar": ExemplarInpainter,
    "lama": LamaInpainter,
    "opencv": OpencvInpainter,
    "propainter": PropainterInpainter,
}


def is_inpainter(name: str) -> bool:
    """Return whether a name is that of a built-in inpainter or of a `package.module:Class`."""
    return name in INPAINTERS or ":" in name


def inpainter_class(name: str) -> type[Inpainter]:
    """Return the class of an inpainter.

    Args:
        name: a key of `INPAINTERS`, or `package.module:Class` for a class of another package.

    Raises:
        InputError: the name is unknown, or the other package cannot be imported.
    """
    if ":" in name:
        plugin: type[Inpainter] = load_plugin(name, "inpainter")
        return plugin
    check_name("inpainter", name, INPAINTERS)
    return INPAINTERS[name]


def get_inpainter(name: str, options: InpainterOptions) -> Inpainter:
    """Open an inpainter by its name, see `inpainter_class`.

    Raises:
        InputError: the name is unknown, or a package or weights are missing.
    """
    return inpainter_class(name)(options)
