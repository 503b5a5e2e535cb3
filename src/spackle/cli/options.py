"""Options that several commands have, each declared once as an annotated type.

`path_options` collects those of camera path and video, which `predict` and `render` share.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer.core import TyperOption

from spackle.runtime.errors import InputError

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.views import PathOptions

INTERRUPTED = 130  # exit code after Ctrl-C, as shells report it
PAPER_PANEL = "The paper's experiments"  # where help lists the commands that repeat them

# Names of the library's registries, which cannot be imported here, because help must not wait for
# torch. A test compares them.
SharpTrajectoryName = Literal["swipe", "shake", "rotate", "rotate-forward"]
TrajectoryName = Literal[SharpTrajectoryName, "vertical", "orbit", "dolly-zoom"]
PrecisionName = Literal["auto", "fp32", "bf16"]
DepthKindName = Literal["auto", "metric", "disparity", "near-white", "near-black"]
DATASET_BASES = "sharp, moge, lite, hf:NAME, package.module:Class, or rgbd with depth maps"
INPAINTERS = "exemplar, lama, opencv, propainter, or package.module:Class"
DATASETS = "middlebury, booster, wildrgbd, tanks, eth3d, llff, pairs (your own), or photos alone"
METHODS = "base, paper-initial, paper, spackle, spackle-scene, initial, dense, inpaint2d, direct-ft"
METRICS = "clipiqa, niqe, musiq, psnr, ssim, distance, dists, lpips"
WEIGHTS = "depth (MoGe-2), sharp, lama, features or squeezenet"

DEVICE_NAME = re.compile(r"auto|cpu|cuda(:(?P<number>[0-9]{1,3}))?")

# The machine.
PrecisionOption = Annotated[PrecisionName, typer.Option(help="Precision of the base's network.")]


def use_gpu_alone(name: str) -> str:
    """The device without the number of a GPU, which becomes the only one that torch sees.

    So all that runs in this process, and in processes that it starts, uses this GPU. InputError for
    an unknown name.
    """
    match = DEVICE_NAME.fullmatch(name)
    if match is None:
        raise InputError(f"--device {name}: give auto, cpu, cuda, or one GPU such as cuda:1")
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
    typer.Option(
        metavar="auto|cpu|cuda|cuda:N",
        callback=use_gpu_alone,
        help="Device of networks and renderer; cuda:1: the second GPU.",
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
    int | None,
    typer.Option(
        metavar="N",
        hidden=True,
        help="SHARP computes N of its 35 windows at once (default 5, on a GPU all); "
        "1 takes least memory.",
    ),
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
    Path | None,
    typer.Option(
        "-c",
        "--checkpoint",
        metavar="FILE",
        help="Weights of the base: of sharp, moge or lite; with auto of sharp.",
    ),
]
FovOption = Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")]
KeepFrameOption = Annotated[
    bool,
    typer.Option(
        "--keep-frame", help="Keep a scan's margin or letterbox bars, which are cropped by default."
    ),
]
DepthKindOption = Annotated[
    DepthKindName,
    typer.Option(
        hidden=True,
        help="What the numbers in --depth mean. metric: metres, or millimetres in a 16-bit PNG; "
        "disparity: pixels of a calibrated pair; near-white: relative depth, near is bright, as "
        "MiDaS, Depth Anything and ComfyUI write it; near-black: relative depth, near is dark. "
        "auto: disparity if there is a calibration, else metric.",
    ),
]
DepthUnitOption = Annotated[
    str | None,
    typer.Option(
        metavar="UNIT",
        help="Unit of --depth: m, cm, mm, km, or a number of metres, such as 1/256 for KITTI; "
        "1/m: inverse depth.",
        show_default="mm in a PNG or TIFF of 16 bits, else m",
    ),
]

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
TrajectoryOption = Annotated[
    TrajectoryName | None,
    typer.Option(help="Camera path of the video.", show_default="rotate-forward"),
]
DisparityOption = Annotated[
    float | None,
    typer.Option(
        help="How far the camera moves to the side, as a disparity from 0 to 2; 0.3 is large.",
        show_default="the saved scene's; predict: chosen for the photo, at most 0.15 with lite, "
        "else 0.3",
    ),
]
PathFileOption = Annotated[
    Path | None,
    typer.Option(
        "--path",
        metavar="FILE",
        hidden=True,
        help="Keyframes of a path, see docs/video.md; or cameras as those of --cameras.",
    ),
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        hidden=True,
        help="Complete the views in a file instead of a path: Spackle's, transforms.json of "
        "nerfstudio, cameras.json of 3DGS, a COLMAP folder and others, see docs/inputs.md.",
    ),
]
FramesOption = Annotated[
    int | None, typer.Option(hidden=True, help="Number of frames, instead of --seconds.")
]
SecondsOption = Annotated[
    float | None,
    typer.Option(
        help="Length of the video in seconds.", show_default="4, or the duration of --path"
    ),
]
OverscanOption = Annotated[
    float | None,
    typer.Option(
        metavar="SHARE",
        hidden=True,
        help="Increase the focal length by this fraction, which hides most of the area beyond the "
        "photo's border.",
        show_default="0.05; 0 with --path and --cameras",
    ),
]

# The video.
VideoFormatOption = Annotated[
    Literal["mp4", "webm", "gif", "webp"] | None,
    typer.Option("--format", help="Video format.", show_default="mp4"),
]
FpsOption = Annotated[
    float | None, typer.Option(help="Frames a second.", show_default="30", hidden=True)
]
LoopOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        hidden=True,
        help="Show the video N times; 0: for ever.",
        show_default="0 for gif and webp, else 1",
    ),
]
SizeOption = Annotated[
    str | None,
    typer.Option(
        metavar="WxH",
        help="Size of the video (of one eye's view): 1280x720, or 16:9, 9:16 or 1:1.",
    ),
]
FitOption = Annotated[
    Literal["pad", "blur", "crop"],
    typer.Option(
        hidden=True,
        help="How to reach the aspect ratio of --size: black or blurred margins, or cropping.",
    ),
]
ShowOption = Annotated[
    Literal["color", "depth"],
    typer.Option(
        hidden=True, help="Show the scene's colours, or its depth as colours (near is bright)."
    ),
]
StereoOption = Annotated[
    Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"] | None,
    typer.Option(
        hidden=True, help="Stereo video: side by side, over-under, or for red-cyan glasses."
    ),
]
IpdOption = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        hidden=True,
        help="Distance of the eyes.",
        show_default="by the scene's depth",
    ),
]
ConvergenceOption = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        hidden=True,
        help="Depth that appears in the plane of the screen.",
        show_default="depth of the point that the camera looks at",
    ),
]


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
    trajectory: TrajectoryName | None,
    disparity: float | None,
    path: Path | None,
    cameras: Path | None,
    frames: int | None,
    seconds: float | None,
    video_format: Literal["mp4", "webm", "gif", "webp"] | None,
    fps: float | None,
    loop: int | None,
    overscan: float | None,
    size: str | None,
    fit: Literal["pad", "blur", "crop"],
    show: Literal["color", "depth"],
    stereo: Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"] | None,
    ipd: float | None,
    convergence: float | None,
    compare: bool = False,
) -> PathOptions:
    """Collect the options of camera path and video; None is an option that is not given.

    Raises:
        InputError: an option would have no effect, because --path or --cameras sets the views.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.core.trajectories import DEFAULT_OVERSCAN
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
        overscan=DEFAULT_OVERSCAN if overscan is None else overscan,
    )
