"""The table of inpainters. To add one: write its class in a file of this room, and add a line here.

An inpainter that lies outside of Spackle needs no line: its name is `package.module:Class`.
"""

from __future__ import annotations

from spackle.inpaint.lama import LamaInpainter
from spackle.inpaint.plain import ExemplarInpainter, OpencvInpainter
from spackle.inpaint.propainter import PropainterInpainter
from spackle.inpaint.protocol import Inpainter, InpainterOptions
from spackle.runtime.plugins import check_name_or_plugin, is_plugin, load_plugin

# Packages such as OpenCV are imported only when one of these classes is called.
INPAINTERS: dict[str, type[Inpainter]] = {
    "exemplar": ExemplarInpainter,
    "lama": LamaInpainter,
    "opencv": OpencvInpainter,
    "propainter": PropainterInpainter,
}


# What a class of another package must have.
NEEDED_ATTRIBUTES = ("name", "version", "uses_network", "paints_views_together", "notice", "paint")


def is_inpainter(name: str) -> bool:
    """Return whether a name is that of a built-in inpainter or of a `package.module:Class`."""
    return name in INPAINTERS or is_plugin(name)


def inpainter_class(name: str, option: str = "inpainter") -> type[Inpainter]:
    """Return the class of an inpainter.

    Args:
        name: a key of `INPAINTERS`, or `package.module:Class` for a class of another package.
        option: the Python name of the option that was given, for messages.

    Raises:
        InputError: the name is unknown, or the other package cannot be imported.
    """
    check_name_or_plugin(option, name, INPAINTERS)
    if not is_plugin(name):
        return INPAINTERS[name]
    plugin: type[Inpainter] = load_plugin(
        name, option, needs=NEEDED_ATTRIBUTES, like="spackle.inpaint.plain.PlainInpainter"
    )
    return plugin


def get_inpainter(name: str, options: InpainterOptions, option: str = "inpainter") -> Inpainter:
    """Open an inpainter by its name, see `inpainter_class`.

    Raises:
        InputError: the name is unknown, or a package or weights are missing.
    """
    return inpainter_class(name, option)(options)
