"""Options that several commands have, each declared once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperOption

from spackle.runtime.errors import InputError, check_name

if TYPE_CHECKING:  # torch takes seconds to load
    from spackle.views import PathOptions

INTERRUPTED = 130  # exit code after Ctrl-C, as shells report it

# The names of `TrajectoryKind`.
SharpTrajectoryName = Literal["swipe", "shake", "rotate", "rotate-forward"]
TrajectoryName = Literal[SharpTrajectoryName, "vertical", "orbit", "dolly-zoom"]
PrecisionName = Literal["auto", "fp32", "bf16"]
DepthKindName = Literal["auto", "metric", "disparity", "near-white", "near-black"]
PrecisionOption = Annotated[PrecisionName, typer.Option(help="Precision of the base's network.")]
DeviceOption = Annotated[
    Literal["auto", "cpu", "cuda"], typer.Option(help="Device of networks and renderer.")
]
FovOption = Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")]
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
        help="What the numbers in --depth mean. metric: metres, or millimetres in a 16-bit PNG; disparity: pixels of a "
        "calibrated pair; near-white: relative depth, near is bright, as MiDaS, Depth Anything and ComfyUI write it; "
        "near-black: relative depth, near is dark. auto: disparity if there is a calibration, else metric.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print each result or error as a line of JSON.")
]
VerboseOption = Annotated[
    bool, typer.Option("-v", "--verbose", help="Print the duration of each stage.")
]
CheckpointOption = Annotated[
    Path | None,
    typer.Option(
        "-c", "--checkpoint", metavar="FILE", help="Weights of sharp (or auto), moge or lite."
    ),
]
SharpOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sharp",
        metavar="KEY=VALUE",
        help="windows=N: SHARP computes N of its 35 windows at once (default 5, on a GPU all); 1 takes least memory.",
        hidden=True,
    ),
]


def _help_all(context: typer.Context, asked: bool) -> None:
    """Print the help with hidden options."""
    if asked:
        for parameter in context.command.params:
            if isinstance(parameter, TyperOption):
                parameter.hidden = False
        print(context.get_help())
        raise typer.Exit()


HelpAllOption = Annotated[
    bool,
    typer.Option(
        "--help-all", is_eager=True, callback=_help_all, help="Show this help with all options."
    ),
]


def sharp_speed(words: Sequence[str] | None) -> dict[str, Any]:
    """`windows_per_batch` of `BaseSettings` from the values of --sharp; InputError for other values."""
    speed: dict[str, Any] = {}
    for word in words or ():
        key, _, value = word.partition("=")
        check_name("sharp", key, ("windows",))
        if not value.isdecimal():
            raise InputError(f"--sharp {word}: give windows=N")
        speed["windows_per_batch"] = int(value)
    return speed


def path_options(
    *,
    trajectory: Annotated[
        TrajectoryName | None,
        typer.Option(help="Camera path of the video.", show_default="rotate-forward"),
    ] = None,
    disparity: Annotated[
        float | None,
        typer.Option(
            help="How far the camera moves to the side, as a disparity from 0 to 2; 0.3 is large.",
            show_default="the saved scene's; predict: chosen for the photo, at most 0.15 with lite, else 0.3",
        ),
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(
            "--path",
            metavar="FILE.json",
            hidden=True,
            help="Keyframes of a path, see docs/video.md.",
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json", hidden=True, help="Complete the views in a file instead of a path."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(hidden=True, help="Number of frames, instead of --seconds.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Length of the video in seconds.", show_default="4, or the duration of --path"
        ),
    ] = None,
    video_format: Annotated[
        Literal["mp4", "webm", "gif", "webp"] | None,
        typer.Option("--format", help="Video format.", show_default="mp4"),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames a second.", show_default="30", hidden=True)
    ] = None,
    loop: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            hidden=True,
            help="Show the video N times; 0: for ever.",
            show_default="0 for gif and webp, else 1",
        ),
    ] = None,
    overscan: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            hidden=True,
            help="Increase the focal length by this fraction, which hides most of the area beyond the photo's border.",
            show_default="0.05; 0 with --path and --cameras",
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Size of the video (of one eye's view): 1280x720, or 16:9, 9:16 or 1:1.",
        ),
    ] = None,
    fit: Annotated[
        Literal["pad", "blur", "crop"],
        typer.Option(
            hidden=True,
            help="How to reach the aspect ratio of --size: black or blurred margins, or cropping.",
        ),
    ] = "pad",
    show: Annotated[
        Literal["color", "depth"],
        typer.Option(
            hidden=True, help="Show the scene's colours, or its depth as colours (near is bright)."
        ),
    ] = "color",
    stereo: Annotated[
        Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"] | None,
        typer.Option(
            hidden=True, help="Stereo video: side by side, over-under, or for red-cyan glasses."
        ),
    ] = None,
    ipd: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            hidden=True,
            help="Distance of the eyes.",
            show_default="by the scene's depth",
        ),
    ] = None,
    convergence: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            hidden=True,
            help="Depth that appears in the plane of the screen.",
            show_default="depth of the point that the camera looks at",
        ),
    ] = None,
) -> PathOptions:
    """Collect the options of camera path and video.

    Raises:
        InputError: an option would have no effect, because --path or --cameras sets the views.
    """
    from spackle.core.trajectories import DEFAULT_OVERSCAN
    from spackle.video.options import VideoOptions, parse_size
    from spackle.views import PathOptions

    useless: dict[str, object] = {
        "--trajectory": trajectory,
        "--disparity": disparity,
        "--overscan": overscan,
    }
    useless |= {} if cameras is None else {"--frames": frames, "--seconds": seconds}
    for option, value in useless.items():
        if value is not None and (path, cameras) != (None, None):
            raise InputError(
                f"{option} {value}: has no effect, because --path or --cameras sets the views"
            )
    pixels = None if size is None else parse_size(size)
    video = VideoOptions(
        format=video_format,
        fps=fps,
        loop=loop,
        size=pixels,
        fit=fit,
        show=show,
        stereo=stereo,
        ipd=ipd,
        convergence=convergence,
    )
    kind, zoom = trajectory or "rotate-forward", DEFAULT_OVERSCAN if overscan is None else overscan
    return PathOptions(
        trajectory=kind,
        disparity=disparity,
        cameras=cameras,
        path=path,
        frames=frames,
        seconds=seconds,
        video=video,
        overscan=zoom,
    )


def with_path_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --help-all and the options of `path_options` to a command; it gets these options as the argument `path`."""
    declared, shared = (
        inspect.signature(function, eval_str=True, locals={"PathOptions": object}).parameters
        for function in (command, path_options)
    )
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters: list[inspect.Parameter] = []
    for name, option in declared.items():
        parameters += shared.values() if name == "path" else [option.replace(kind=kind)]
    parameters.append(inspect.Parameter("help_all", kind, default=False, annotation=HelpAllOption))

    def expanded(*, help_all: bool, **values: Any) -> None:
        path = path_options(**{name: values.pop(name) for name in shared})
        command(**values, path=path)

    expanded.__name__, expanded.__doc__ = command.__name__, command.__doc__
    expanded.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    expanded.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return expanded
