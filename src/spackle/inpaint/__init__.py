"""All that fills the holes of pictures: one protocol, and the registry where a name becomes an inpainter.

To add an inpainter, write a class in a file of its own (see `Inpainter`), add a line to `INPAINTERS`, and test it.
"""

from __future__ import annotations

from spackle.errors import InputError
from spackle.inpaint.geometry import GeometryInpainter, NoInpainter
from spackle.inpaint.opencv import OpencvInpainter
from spackle.inpaint.propainter import PropainterInpainter
from spackle.inpaint.protocol import Inpainter, InpainterOptions, SceneCompletion, ViewStack

__all__ = ["INPAINTERS", "Inpainter", "InpainterOptions", "SceneCompletion", "ViewStack", "get_inpainter"]

INPAINTERS: dict[str, type[Inpainter]] = {
    "geometry": GeometryInpainter,
    "opencv": OpencvInpainter,
    "propainter": PropainterInpainter,
    "none": NoInpainter,
}


def get_inpainter(name: str, options: InpainterOptions) -> Inpainter:
    """An inpainter by its name.

    Raises:
        InputError: an unknown one, one whose package or weights are missing, or an option that it has no use for.
    """
    if name not in INPAINTERS:
        raise InputError(f"--inpainter {name}: unknown; there are {', '.join(INPAINTERS)}")
    kind = INPAINTERS[name]
    for option, given in (("weights", options.weights), ("side", options.side)):
        if given is not None and not kind.network:
            raise InputError(f"--inpainter-{option} {given}: the {name} inpainter has no network: leave the option out")
    return kind(options)
