"""The options of a scene and its video, declared once for commands, Python and HTTP.

Read `DeclaredOptions`: a field says name, type, default, limits and help of an option.
`cli/options.py:declared` makes an option of a command of it, and `web/work.py:declared_field` a
field of the HTTP interface. Functions in Python have a signature of their own, which editors and
type checkers can read; a test compares all three.

Nothing here needs torch, because the help of a command must not wait for it.
"""

# ruff: noqa: RUF009 (`_option` is called once, for the class, as it is meant)

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any, Literal

# Names that options can have as values.
SharpTrajectory = Literal["swipe", "shake", "rotate", "rotate-forward"]  # those of SHARP's programs
TrajectoryKind = Literal[SharpTrajectory, "vertical", "orbit", "dolly-zoom"]
DepthKind = Literal["auto", "metric", "disparity", "near-white", "near-black"]
DeviceName = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "fp32", "bf16"]
# The built-in sources of the texture in the holes, see `spackle.pipeline.open_texture`.
FillTexture = Literal["auto", "network", "exemplar", "lama", "none"]
# One set of aux Gaussians for all views; one set for each view; or one set for each view by the
# paper's method alone, without what Spackle adds to it.
FillMode = Literal["scene", "view", "paper"]
# What a dataset keeps of its views. "targets" leaves out what the photo's Gaussians give again: the
# rendered views. Of a target only the holes are kept, because elsewhere it is the view.
KeptFiles = Literal["all", "targets"]
VideoFormatName = Literal["mp4", "webm", "gif", "webp"]
# For a view of another aspect ratio than the video's: black margins, blurred margins, or cropping.
Fit = Literal["pad", "blur", "crop"]
# Colours, or the depth as colours.
Show = Literal["color", "depth"]
# Two eyes side by side (sbs), one over the other (ou), or mixed for red-cyan glasses.
StereoLayout = Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"]

MAX_DISPARITY = 2.0  # size of a camera's movement; beyond, the photo is out of view
MAX_FRAME_COUNT = 10_000  # frames of a video
STRAIGHT_ANGLE = 180.0  # degrees: no lens sees so much


@dataclasses.dataclass(frozen=True, kw_only=True)
class Declaration:
    """What is known of an option, besides its name."""

    type: Any  # such as `float | None`; None is an option that is not given
    default: Any
    help: str  # other options are in backticks, by their Python names
    unset: str = ""  # what holds if the option is not given, for a default of None
    limits: dict[str, float]  # "ge", "gt", "le" and "lt", as pydantic names them


def _option(default: Any, help: str, unset: str = "", **limits: float) -> Any:
    """A field of `DeclaredOptions`; the arguments are those of `Declaration`."""
    metadata = {"help": help, "unset": unset, "limits": limits}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeclaredOptions:
    """Every option with which a photo becomes a scene and a video."""

    # The photo's geometry.
    base: str = _option(
        "auto",
        "Base, which turns the photo into Gaussians. rgbd: a depth map; sharp: Apple's network; "
        "moge: MoGe-2, with metric depth and focal length; lite: small networks inside Spackle, "
        "with rough depth; hf:OWNER/NAME or hf:FOLDER: a depth model of transformers; "
        "package.module:Class: a base of another package. auto: the given depth map, or the one in "
        "the photo's file, else sharp or moge if their weights are downloaded, else lite.",
    )
    depth_kind: DepthKind = _option(
        "auto",
        "What the numbers in `depth` mean. metric: metres, or millimetres in a 16-bit PNG; "
        "disparity: pixels of a calibrated pair; near-white: relative depth, near is bright, as "
        "MiDaS, Depth Anything and ComfyUI write it; near-black: relative depth, near is dark. "
        "auto: disparity if there is a calibration, else metric.",
    )
    depth_unit: str | None = _option(
        None,
        "Unit of `depth`: m, cm, mm, km, or a number of metres, such as 1/256 for KITTI; "
        "1/m: inverse depth.",
        "mm in a PNG or TIFF of 16 bits, else m",
    )
    near: float | None = _option(
        None, "Distance in metres of the nearest part of a relative `depth`.", "1.5"
    )
    far: float | None = _option(
        None, "Distance in metres of the farthest part of a relative `depth`.", "15"
    )
    calib: Path | None = _option(None, "calib.txt, if it is not in the map's folder.")
    checkpoint: Path | None = _option(
        None, "Weights of the base: of sharp, moge or lite; with auto of sharp."
    )
    precision: Precision = _option(
        "auto", "Precision of the base's network; auto: bf16 if the hardware supports it."
    )
    windows_per_batch: int | None = _option(
        None,
        "SHARP computes N of its 35 windows at once (default 5, on a GPU all); 1 takes least "
        "memory.",
    )
    device: DeviceName = _option("auto", "Device of networks and renderer.")
    focal_px: float | None = _option(None, "Focal length in pixels of the photo.", gt=0)
    focal_mm: float | None = _option(None, "Focal length in mm, 35 mm equivalent.", gt=0)
    fov: float | None = _option(
        None, "Horizontal field of view in degrees.", gt=0, lt=STRAIGHT_ANGLE
    )
    keep_frame: bool = _option(
        False, "Keep a scan's margin or letterbox bars, which are cropped by default."
    )

    # The fill of the holes.
    residual: str | None = _option(
        None,
        "Weights of the residual. initial: no network; none: no fill. Default: the weights in the "
        "package.",
    )
    residual_network: str | None = _option(
        None, "The network of `residual`, if another package defines it."
    )
    fill: str = _option(
        "auto",
        "Texture in the holes. lama: LaMa (`spackle weights get lama`); exemplar: patches of the "
        "photo; network: no texture; none: no fill; package.module:Class: an inpainter of another "
        "package; auto: lama if its weights are downloaded, else exemplar.",
    )
    mode: FillMode = _option(
        "scene",
        "scene: one set of aux Gaussians for all views; view: a set for each view; paper: a set "
        "for each view by the paper's method alone (eqs. 2 to 9): one pass, no occlusion guard, no "
        "texture.",
    )

    # The camera path.
    trajectory: TrajectoryKind = _option("rotate-forward", "Camera path of the video.")
    disparity: float | None = _option(
        None,
        "How far the camera moves to the side, as a disparity from 0 to 2; 0.3 is large.",
        "chosen for the photo, at most 0.1 with lite, else 0.3",
        ge=0,
        le=MAX_DISPARITY,
    )
    path: Path | None = _option(
        None, "Keyframes of a path, see docs/video.md; or cameras as those of `cameras`."
    )
    cameras: Path | None = _option(
        None,
        "Complete the views in a file instead of a path: Spackle's, transforms.json of nerfstudio, "
        "cameras.json of 3DGS, a COLMAP folder and others, see docs/inputs.md.",
    )
    frames: int | None = _option(
        None, "Number of frames, instead of `seconds`.", ge=1, le=MAX_FRAME_COUNT
    )
    seconds: float | None = _option(
        None, "Length of the video in seconds.", "4, or the duration of `path`", gt=0
    )
    overscan: float | None = _option(
        None,
        "Increase the focal length by this fraction, which hides most of the area beyond the "
        "photo's border.",
        "chosen for the photo, 0.03 to 0.08; 0 with `path` and `cameras`",
    )

    # The video.
    format: VideoFormatName | None = _option(None, "Video format.", "mp4")
    fps: float | None = _option(None, "Frames a second.", "30")
    loop: int | None = _option(
        None, "Show the video N times; 0: for ever.", "0 for gif and webp, else 1"
    )
    size: str | None = _option(
        None, "Size of the video (of one eye's view): 1280x720, or 16:9, 9:16 or 1:1."
    )
    fit: Fit = _option(
        "pad",
        "How to reach the aspect ratio of `size`: black or blurred margins, or cropping.",
    )
    show: Show = _option(
        "color", "Show the scene's colours, or its depth as colours (near is bright)."
    )
    stereo: StereoLayout | None = _option(
        None, "Stereo video: side by side, over-under, or for red-cyan glasses."
    )
    ipd: float | None = _option(None, "Distance of the eyes.", "by the scene's depth")
    convergence: float | None = _option(
        None,
        "Depth that appears in the plane of the screen.",
        "depth of the point that the camera looks at",
    )


def _declarations() -> dict[str, Declaration]:
    """The declaration of each option, by its Python name."""
    types = typing.get_type_hints(DeclaredOptions)
    return {
        field.name: Declaration(type=types[field.name], default=field.default, **field.metadata)
        for field in dataclasses.fields(DeclaredOptions)
    }


DECLARATIONS = _declarations()
