"""Choices and options that several commands have."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

import typer

INTERRUPTED = 130  # what shells report of a command that Ctrl-C ended


class Trajectory(str, Enum):
    """Camera paths, as the command line spells them."""

    swipe = "swipe"
    shake = "shake"
    rotate = "rotate"
    rotate_forward = "rotate-forward"


class PrecisionChoice(str, Enum):
    """What the base's network computes in."""

    auto = "auto"
    fp32 = "fp32"
    bf16 = "bf16"


class Device(str, Enum):
    """Where to render."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


DeviceOption = Annotated[Device, typer.Option(help="Where to compute.")]
VerboseOption = Annotated[bool, typer.Option("-v", "--verbose", help="Say how long each stage takes.")]
