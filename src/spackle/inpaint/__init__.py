"""All that fills the holes of pictures: one protocol, and the registry where a name becomes an inpainter.

To add an inpainter, write a class in a file of its own (see `Inpainter`), add a line to `INPAINTERS`, and test it.
"""

from __future__ import annotations

from spackle.errors import check_name
from spackle.inpaint.exemplar import ExemplarInpainter
from spackle.inpaint.lama import LamaInpainter
from spackle.inpaint.opencv import OpencvInpainter
from spackle.inpaint.propainter import PropainterInpainter
from spackle.inpaint.protocol import Inpainter, InpainterOptions, known_inverse_depth

__all__ = ["INPAINTERS", "Inpainter", "InpainterOptions", "get_inpainter", "known_inverse_depth"]

INPAINTERS: dict[str, type[Inpainter]] = {
    "exemplar": ExemplarInpainter,
    "lama": LamaInpainter,
    "opencv": OpencvInpainter,
    "propainter": PropainterInpainter,
}


def get_inpainter(name: str, options: InpainterOptions) -> Inpainter:
    """An inpainter by its name; InputError for an unknown one, or one whose package or weights are missing."""
    check_name("inpainter", name, INPAINTERS)
    return INPAINTERS[name](options)
