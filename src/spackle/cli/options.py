"""Choices and options that several commands have."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spackle.errors import InputError

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.camera_path import TrajectoryKind
    from spackle.jobs.video_options import VideoOptions

DEFAULT_DISPARITY = 0.3
INTERRUPTED = 130  # what shells report of a command that Ctrl-C ended


class Trajectory(str, Enum):
    """Camera paths, as the command line spells them."""

    swipe = "swipe"
    shake = "shake"
    rotate = "rotate"
    rotate_forward = "rotate-forward"


SPELLINGS = [kind.value for kind in Trajectory]


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


class ModeChoice(str, Enum):
    """One scene for all views, or the paper's Gaussians for each view."""

    scene = "scene"
    view = "view"


class FormatChoice(str, Enum):
    """Kinds of video."""

    mp4 = "mp4"
    webm = "webm"
    gif = "gif"
    webp = "webp"


class ShowChoice(str, Enum):
    """What a video shows of the scene."""

    color = "color"
    depth = "depth"


class StereoChoice(str, Enum):
    """How two eyes' views share a frame."""

    sbs = "sbs"
    sbs_half = "sbs-half"
    ou = "ou"
    ou_half = "ou-half"
    anaglyph = "anaglyph"


def trajectory_named(text: str) -> Trajectory:
    """A trajectory as the command line or as Python spells it; BadParameter where there is none."""
    spelled = text.replace("_", "-")
    if spelled not in SPELLINGS:
        raise typer.BadParameter(f"{text!r} is not one of {', '.join(map(repr, SPELLINGS))}.")
    return Trajectory(spelled)


def trajectory_option(words: str, default: str | None = None) -> Any:
    """The option --trajectory; `default` is what the help shows."""
    return typer.Option(
        help=words,
        show_default=default or False,
        parser=trajectory_named,
        metavar=f"[{'|'.join(SPELLINGS)}]",
        autocompletion=lambda: SPELLINGS,
    )


# Of a video: `predict` and `render` have the same.
TrajectoryOption = Annotated[
    Trajectory | None, trajectory_option("Camera path of the video.", Trajectory.rotate_forward.value)
]
PathOption = Annotated[
    Path | None,
    typer.Option("--path", metavar="FILE.json", help="A camera path of your own: keyframes, see docs/video.md."),
]
DisparityOption = Annotated[
    float | None,
    typer.Option(help="How far the camera moves: 0 to 2; 0.3 is large.", show_default=str(DEFAULT_DISPARITY)),
]
CamerasOption = Annotated[
    Path | None, typer.Option(metavar="FILE.json", help="Exactly these views in place of a path.")
]
FramesOption = Annotated[
    int | None, typer.Option(help="Frames of the path.", show_default="60, or the keyframes' seconds")
]
FormatOption = Annotated[FormatChoice | None, typer.Option("--format", help="Kind of video.", show_default="mp4")]
FpsOption = Annotated[float | None, typer.Option(help="Frames a second.", show_default="30")]
LoopOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="Show the video N times; 0: for ever.", show_default="0 for gif and webp, else 1"),
]
SizeOption = Annotated[
    str | None, typer.Option(metavar="WxH", help="Size of the video (of one eye's view), e.g. 1280x720.")
]
ShowOption = Annotated[ShowChoice, typer.Option(help="The scene's colours, or its depth as colours (near is bright).")]
StereoOption = Annotated[
    StereoChoice | None, typer.Option(help="Two eyes: side by side, over-under, or for red-cyan glasses.")
]
IpdOption = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Distance of the two eyes.", show_default="as suits the scene's depth"),
]
ConvergenceOption = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Depth at which the screen stands.", show_default="what the path looks at"),
]
DeviceOption = Annotated[Device, typer.Option(help="Where to compute.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="For scripts: print each result, and an error, as a line of JSON.")
]
VerboseOption = Annotated[bool, typer.Option("-v", "--verbose", help="Say how long each stage takes.")]


def video_options(
    kind: FormatChoice | None,
    fps: float | None,
    loop: int | None,
    size: str | None,
    show: ShowChoice,
    stereo: StereoChoice | None,
    ipd: float | None,
    convergence: float | None,
) -> VideoOptions:
    """The options of a video as one value."""
    from spackle.jobs.video_options import VideoOptions, parse_size

    return VideoOptions(
        format=None if kind is None else kind.value,
        fps=fps,
        loop=loop,
        size=None if size is None else parse_size(size),
        show=show.value,
        stereo=None if stereo is None else stereo.value,
        ipd=ipd,
        convergence=convergence,
    )


def chosen_way(
    trajectory: Trajectory | None, disparity: float | None, frames: int | None, path: Path | None, cameras: Path | None
) -> tuple[TrajectoryKind, float]:
    """The trajectory and how far it goes, given or not.

    Raises:
        InputError: --path or --cameras gives other views, to which an option would mean nothing.
    """
    given = {"--trajectory": trajectory and trajectory.value, "--disparity": disparity}
    says = f"--path {path}: is a camera path of its own"
    if cameras is not None and path is None:
        given["--frames"] = frames
        says = f"--cameras {cameras}: gives the views themselves"
    for option, value in given.items():
        if value is not None and (path is not None or cameras is not None):
            raise InputError(f"{says}: leave {option} {value} out")
    kind = (trajectory or Trajectory.rotate_forward).name
    return kind, DEFAULT_DISPARITY if disparity is None else disparity  # type: ignore[return-value]  # named as paths are
