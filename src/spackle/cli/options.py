"""Options that several commands have, each once as an annotated type.

`declared` makes them of `runtime/declared_options.py`, which Python and HTTP use, too.
`path_options` collects those of camera path and video, which `predict` and `render` share.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.core import TyperOption

from spackle.runtime.declared_options import (
    DECLARATIONS,
    DepthKind,
    DeviceName,
    Fit,
    Precision,
    Show,
    StereoLayout,
    TrajectoryKind,
    VideoFormatName,
)
from spackle.runtime.errors import InputError, unknown_name

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.views import PathOptions

BAD_INPUT = 2  # exit code after a message about the input
INTERRUPTED = 130  # exit code after Ctrl-C, as shells report it
PAPER_PANEL = "The paper's experiments"  # where help lists the commands that repeat them

DATASET_BASES = "sharp, moge, lite, hf:NAME, package.module:Class, or rgbd with depth maps"
INPAINTERS = "exemplar, lama, opencv, propainter, or package.module:Class"
DATASETS = "middlebury, booster, wildrgbd, tanks, eth3d, llff, pairs (your own), or photos alone"
METHODS = "base, paper-initial, paper, spackle, spackle-scene, initial, dense, inpaint2d, direct-ft"
METRICS = "clipiqa, niqe, musiq, psnr, ssim, distance, dists, lpips"
WEIGHTS = "depth (MoGe-2), sharp, lama, features or squeezenet"

DEVICE_NAME = re.compile(r"auto|cpu|cuda(:(?P<number>[0-9]{1,3}))?")


def declared(
    name: str, *flags: str, unset: str | None = None, more_help: str = "", **look: Any
) -> Any:
    """The typer option of a declared option: its help, with other options named as flags.

    Args:
        name: Python name of the option, one of `DeclaredOptions`.
        flags: how the user writes it, if not as its name.
        unset: what holds without the option, if not what is declared.
        more_help: what only a command can do.
        **look: further arguments of `typer.Option`, such as `metavar` and `hidden`.
    """
    declaration = DECLARATIONS[name]
    default_text = declaration.unset if unset is None else unset
    return typer.Option(
        *flags,
        help=_with_flags(declaration.help) + more_help,
        show_default=_with_flags(default_text) or True,
        **look,
    )


def _with_flags(text: str) -> str:
    """The text, with every declared option in backticks replaced by its flag."""

    def flag_of(match: re.Match[str]) -> str:
        """The flag of the name in backticks; the text as it is for any other word."""
        is_option = match[1] in DECLARATIONS or match[1] == "depth"  # the depth is an input file
        return "--" + match[1].replace("_", "-") if is_option else match[0]

    return re.sub(r"`([a-z_]+)`", flag_of, text)


# The machine.
PrecisionOption = Annotated[Precision, typer.Option(help="Precision of the base's network.")]


def use_gpu_alone(name: str) -> str:
    """The device without the number of a GPU, which becomes the only one that torch sees.

    So all that runs in this process, and in processes that it starts, uses this GPU. InputError for
    an unknown name.
    """
    match = DEVICE_NAME.fullmatch(name)
    if match is None:
        raise InputError(
            f"--device {name} is {unknown_name(name, [*get_args(DeviceName), 'cuda:N'])}"
        )
    if match["number"] is None:
        return name
    # The number counts the GPUs that the user has made visible, as torch counts them.
    number = int(match["number"])
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    gpus = str(number) if visible is None else ",".join(visible.split(",")[number : number + 1])
    os.environ["CUDA_VISIBLE_DEVICES"] = gpus
    return "cuda"


DeviceOption = Annotated[
    str,
    declared(
        "device",
        more_help=" cuda:1: the second GPU.",
        metavar="auto|cpu|cuda|cuda:N",
        callback=use_gpu_alone,
    ),
]
# Several processes, on this machine or on a cluster.
WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1024,
        help="Number of processes, each with a copy of the networks; default: one for each GPU, "
        "or one; with --ray as many as there is room for.",
        show_default=False,
    ),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(
        hidden=True,
        min=1,
        max=1024,
        help="Threads of each process; the last bits of a network's output depend on their number.",
        show_default="the cores, shared evenly; with --ray 2",
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto|HOST:PORT|local",
        help="Work on the machines of a Ray cluster; auto: of the one that this machine belongs "
        "to; see docs/scale.md.",
    ),
]
SharpWindowsOption = Annotated[
    int | None, declared("windows_per_batch", "--sharp-windows", metavar="N", hidden=True)
]

# Output.
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print each result or error as a line of JSON.")
]
VerboseOption = Annotated[
    bool, typer.Option("-v", "--verbose", help="Print the duration of each stage.")
]

# The photo and its base.
CheckpointOption = Annotated[
    Path | None, declared("checkpoint", "-c", "--checkpoint", metavar="FILE")
]
FovOption = Annotated[float | None, declared("fov")]
KeepFrameOption = Annotated[bool, declared("keep_frame", "--keep-frame")]
DepthKindOption = Annotated[DepthKind, declared("depth_kind", hidden=True)]
DepthUnitOption = Annotated[str | None, declared("depth_unit", metavar="UNIT")]

# The server.
HostOption = Annotated[
    str,
    typer.Option(
        metavar="H",
        help="Address of the server; 0.0.0.0 admits everybody in the network who has the token.",
    ),
]
PortOption = Annotated[
    int, typer.Option(metavar="N", min=0, max=65535, help="Port of the server; 0: any free one.")
]

# The camera path.
# None as default, because the command must see whether the user has given the option.
TrajectoryOption = Annotated[
    TrajectoryKind | None, declared("trajectory", unset=DECLARATIONS["trajectory"].default)
]
DisparityOption = Annotated[
    float | None,
    declared(
        "disparity",
        unset=f"the saved scene's; predict: {DECLARATIONS['disparity'].unset}",
    ),
]
PathFileOption = Annotated[Path | None, declared("path", "--path", metavar="FILE", hidden=True)]
CamerasOption = Annotated[Path | None, declared("cameras", metavar="FILE", hidden=True)]
FramesOption = Annotated[int | None, declared("frames", hidden=True)]
SecondsOption = Annotated[float | None, declared("seconds")]
OverscanOption = Annotated[float | None, declared("overscan", metavar="SHARE", hidden=True)]

# The video.
VideoFormatOption = Annotated[VideoFormatName | None, declared("format", "--format")]
FpsOption = Annotated[float | None, declared("fps", hidden=True)]
LoopOption = Annotated[int | None, declared("loop", metavar="N", hidden=True)]
SizeOption = Annotated[str | None, declared("size", metavar="WxH")]
FitOption = Annotated[Fit, declared("fit", hidden=True)]
ShowOption = Annotated[Show, declared("show", hidden=True)]
StereoOption = Annotated[StereoLayout | None, declared("stereo", hidden=True)]
IpdOption = Annotated[float | None, declared("ipd", metavar="METRES", hidden=True)]
ConvergenceOption = Annotated[float | None, declared("convergence", metavar="METRES", hidden=True)]


def _print_full_help(context: typer.Context, asked: bool) -> None:
    """Print the help of a command with its hidden options, and end the command.

    Typer calls this with `asked` False if the user did not give --help-all.
    """
    if not asked:
        return
    # Options for few users are hidden, so that the usual help stays short.
    for parameter in context.command.params:
        if isinstance(parameter, TyperOption):
            parameter.hidden = False
    print(context.get_help())
    raise typer.Exit()


HelpAllOption = Annotated[
    bool,
    typer.Option(
        "--help-all",
        is_eager=True,  # before missing arguments are refused
        callback=_print_full_help,
        help="Show this help with all options.",
    ),
]


def path_options(
    *,
    trajectory: TrajectoryKind | None,
    disparity: float | None,
    path: Path | None,
    cameras: Path | None,
    frames: int | None,
    seconds: float | None,
    video_format: VideoFormatName | None,
    fps: float | None,
    loop: int | None,
    overscan: float | None,
    size: str | None,
    fit: Fit,
    show: Show,
    stereo: StereoLayout | None,
    ipd: float | None,
    convergence: float | None,
    compare: bool = False,
) -> PathOptions:
    """Collect the options of camera path and video; None is an option that is not given.

    Raises:
        InputError: an option would have no effect, because --path or --cameras sets the views.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.video.options import VideoOptions, parse_size
    from spackle.views import PathOptions

    # A file of keyframes or views says itself where the camera goes; a file of views also says how
    # many frames there are.
    if path is not None or cameras is not None:
        without_effect: dict[str, object] = {
            "--trajectory": trajectory,
            "--disparity": disparity,
            "--overscan": overscan,
        }
        if cameras is not None:
            without_effect |= {"--frames": frames, "--seconds": seconds}
        for flag, value in without_effect.items():
            if value is not None:
                raise InputError(
                    f"{flag} {value}: has no effect, because --path or --cameras sets the views"
                )

    video = VideoOptions(
        format=video_format,
        fps=fps,
        loop=loop,
        size=None if size is None else parse_size(size),
        fit=fit,
        show=show,
        stereo=stereo,
        ipd=ipd,
        convergence=convergence,
        compare=compare,
    )
    # These defaults stand here, not at the options, so that above a value shows that the user has
    # given it.
    return PathOptions(
        trajectory=trajectory or "rotate-forward",
        disparity=disparity,
        cameras=cameras,
        path=path,
        frames=frames,
        seconds=seconds,
        video=video,
        overscan=overscan,
    )
