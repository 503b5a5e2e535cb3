"""The command line: one thin function a command."""

from __future__ import annotations

import os
import sys
from enum import Enum
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from typer.exceptions import TyperException

from spackle.errors import InputError

INTERRUPTED = 130  # what shells report of a command that Ctrl-C ended

app = typer.Typer(
    name="spackle",
    help="One photo in, a 3D Gaussian scene out that survives a large camera move.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
weights = typer.Typer(help="Weights that others publish: fetch them, list them.", no_args_is_help=True)
app.add_typer(weights, name="weights")


class Trajectory(str, Enum):
    """Camera paths, as the command line spells them."""

    swipe = "swipe"
    shake = "shake"
    rotate = "rotate"
    rotate_forward = "rotate-forward"


class ModeChoice(str, Enum):
    """One scene for all views, or the paper's Gaussians for each view."""

    scene = "scene"
    view = "view"


class PrecisionChoice(str, Enum):
    """What the base's network computes in."""

    auto = "auto"
    fp32 = "fp32"
    bf16 = "bf16"


class NetworkSize(str, Enum):
    """Sizes of SHARP's network."""

    full = "full"
    tiny = "tiny"


class Device(str, Enum):
    """Where to render."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


TrajectoryOption = Annotated[Trajectory, typer.Option(help="Camera path of the video.")]
DisparityOption = Annotated[float, typer.Option(help="How far the camera moves: 0 to 2; 0.3 is large.")]
CamerasOption = Annotated[
    Path | None, typer.Option(metavar="FILE.json", help="Exactly these views in place of a path.")
]
FramesOption = Annotated[int, typer.Option(help="Frames of the path.")]
DeviceOption = Annotated[Device, typer.Option(help="Where to compute.")]
VerboseOption = Annotated[bool, typer.Option("-v", "--verbose", help="Say how long each stage takes.")]


@app.command()
def predict(
    photo: Annotated[Path, typer.Option("-i", "--input", metavar="PHOTO_OR_FOLDER", help="A photo, or a folder.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")],
    base: Annotated[str, typer.Option(help="What turns the photo into Gaussians: rgbd or sharp.")] = "rgbd",
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH_OR_FOLDER",
            help="Depth: .npy, .npz, .pfm (metres), 16-bit .png (mm), or Middlebury disparity.",
        ),
    ] = None,
    calib: Annotated[
        Path | None, typer.Option(metavar="FILE", help="calib.txt of a disparity map that lies elsewhere.")
    ] = None,
    checkpoint: Annotated[Path | None, typer.Option("-c", "--checkpoint", help="Weights of the base.")] = None,
    precision: Annotated[
        PrecisionChoice, typer.Option(help="Of the base's network; auto: bf16 where the hardware multiplies it.")
    ] = PrecisionChoice.auto,
    low_memory: Annotated[bool, typer.Option("--low-memory", help="Take less memory for the base's network.")] = False,
    residual: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|seeds|none",
            help="Weights of the residual. seeds: without any; none: base alone. Default: shipped ones, else seeds.",
        ),
    ] = None,
    render: Annotated[bool, typer.Option(help="Write a video.")] = True,
    trajectory: TrajectoryOption = Trajectory.rotate_forward,
    disparity: DisparityOption = 0.3,
    cameras: CamerasOption = None,
    frames: FramesOption = 60,
    mode: Annotated[
        ModeChoice, typer.Option(help="scene: one set of Gaussians for all views; view: one for each (the paper's).")
    ] = ModeChoice.scene,
    device: DeviceOption = Device.auto,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the photo.")] = None,
    focal_mm: Annotated[float | None, typer.Option(help="Focal length in mm, 35 mm equivalent.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="In a folder: do again what is done already.")] = False,
    verbose: VerboseOption = False,
) -> None:
    """Turn photos into completed 3D scenes: scene.ply, base.ply, video.mp4 and report.json each."""
    from spackle.jobs.options import PredictOptions
    from spackle.jobs.predict import predict_all
    from spackle.jobs.progress import Reporter

    options = PredictOptions(
        base=base,
        depth=depth,
        calib=calib,
        checkpoint=checkpoint,
        precision=precision.value,
        low_memory=low_memory,
        residual=residual,
        render=render,
        trajectory=trajectory.name,  # type: ignore[arg-type]  # the members are named as the paths are
        disparity=disparity,
        cameras=cameras,
        frames=frames,
        mode=mode.value,
        device=device.value,
        focal_px=focal_px,
        focal_mm=focal_mm,
        fov=fov,
        overwrite=overwrite,
    )
    if predict_all(photo, output, options, Reporter(verbose)):
        raise typer.Exit(1)


@app.command()
def render(
    scene: Annotated[Path, typer.Option("-i", "--input", metavar="SCENE.ply", help="A 3D Gaussian scene.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder, or a name ending in .mp4.")],
    trajectory: TrajectoryOption = Trajectory.rotate_forward,
    disparity: DisparityOption = 0.3,
    cameras: CamerasOption = None,
    frames: FramesOption = 60,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Size of the video, e.g. 1280x720.")] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the video.")] = None,
    device: DeviceOption = Device.auto,
    verbose: VerboseOption = False,
) -> None:
    """Draw a saved scene along a camera path."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.render import RenderOptions, parse_size, render_scene

    options = RenderOptions(
        trajectory=trajectory.name,  # type: ignore[arg-type]
        disparity=disparity,
        cameras=cameras,
        frames=frames,
        size=None if size is None else parse_size(size),
        focal_px=focal_px,
        device=device.value,
    )
    render_scene(scene, output, options, Reporter(verbose))


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for the results.")] = Path(
        "demo-output"
    ),
    verbose: VerboseOption = False,
) -> None:
    """Complete the Middlebury Motorcycle photo and compare with the true second photo (needs scikit-image)."""
    from spackle.jobs.demo import run_demo
    from spackle.jobs.progress import Reporter

    run_demo(output, Reporter(verbose))


@app.command()
def train(
    recipe: Annotated[Path, typer.Option("--recipe", metavar="FILE.yaml", help="What to learn from, and how.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder; a run in it goes on.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="In place of the recipe's: optim.steps=100.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start anew where OUT holds a run.")] = False,
    verbose: VerboseOption = False,
) -> None:
    """Train the residual: best.safetensors, last.safetensors, run.json, pictures and logs."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.train import train_recipe

    if train_recipe(recipe, overrides or [], output, Reporter(verbose), overwrite=overwrite) == "stopped":
        raise typer.Exit(INTERRUPTED)


@weights.command("get")
def weights_get(
    name: Annotated[str, typer.Argument(help="Which weights: sharp.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="A folder, or a file name; default: the weights' folder."),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Download from this mirror.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Download what is there already.")] = False,
) -> None:
    """Download weights and record their SHA-256; a broken download goes on where it stopped."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.weights import get_weights

    get_weights(name, output, Reporter(), url=url, force=force)


@weights.command("make")
def weights_make(
    output: Annotated[Path, typer.Argument(metavar="FILE", help="A name that ends in .pt or .safetensors.")],
    size: Annotated[NetworkSize, typer.Option(help="The published size, or one for tests.")] = NetworkSize.full,
) -> None:
    """Make random weights of SHARP's shape, the same each time, to try everything without Apple's."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.weights import make_weights

    make_weights(output, size.value, Reporter())


@weights.command("list")
def weights_list() -> None:
    """Say which weights are known, and which of them are here."""
    from rich.console import Console

    from spackle.jobs.weights import list_weights

    list_weights(Console(highlight=False))


def main() -> None:
    """Entry point: bad input is one line and exit code 2."""
    # Read when torch is loaded. Its idle threads would otherwise spin: where other programs want the cores too,
    # that makes completion three to five times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except TyperException as error:  # an unknown option, a number that is none
        _fail(error.format_message())
    if code == INTERRUPTED:
        print("spackle: interrupted", file=sys.stderr)
    sys.exit(code)


def _fail(message: str) -> NoReturn:
    if message:  # there is none where the help was asked for by giving nothing
        print(f"spackle: {' '.join(message.splitlines())}", file=sys.stderr)
    sys.exit(2)
