"""Inpainters paint the holes of rendered views.

Read `protocol.py` first, which says what an inpainter is; `registry.py` lists them by name.
"""

from spackle.inpaint.protocol import Inpainter, InpainterOptions, known_inverse_depth
from spackle.inpaint.registry import INPAINTERS, get_inpainter, inpainter_class, is_inpainter

__all__ = [
    "INPAINTERS",
    "Inpainter",
    "InpainterOptions",
    "get_inpainter",
    "inpainter_class",
    "is_inpainter",
    "known_inverse_depth",
]
