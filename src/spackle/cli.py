"""The command line: one thin function a command."""

from __future__ import annotations

import os
import sys
from enum import Enum
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from typer.exceptions import TyperException

from spackle.cli_evaluate import register
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
dataset = typer.Typer(help="Photos to views with holes and completed targets, to train on.", no_args_is_help=True)
app.add_typer(dataset, name="dataset")


class Trajectory(str, Enum):
    """Camera paths, as the command line spells them."""

    swipe = "swipe"
    shake = "shake"
    rotate = "rotate"
    rotate_forward = "rotate-forward"


class InpainterChoice(str, Enum):
    """What completes the views of a dataset."""

    geometry = "geometry"
    opencv = "opencv"
    propainter = "propainter"
    none = "none"


class MethodChoice(str, Enum):
    """What learns."""

    residual = "residual"
    direct_ft = "direct-ft"


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
DatasetArgument = Annotated[str, typer.Argument(metavar="DATASET", help="A folder, or an address (s3://…).")]
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
    method: Annotated[
        MethodChoice, typer.Option(help="What learns: the residual; direct-ft: SHARP's own decoder, for comparison.")
    ] = MethodChoice.residual,
    checkpoint: Annotated[
        Path | None, typer.Option("-c", "--checkpoint", metavar="FILE", help="Weights of SHARP, for direct-ft.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start anew where OUT holds a run.")] = False,
    verbose: VerboseOption = False,
) -> None:
    """Train the residual, or SHARP itself: best.safetensors, last.safetensors, run.json, pictures and logs."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.train import train_recipe

    speaker, choices = Reporter(verbose), overrides or []
    ended = train_recipe(
        recipe, choices, output, speaker, method=method.value, checkpoint=checkpoint, overwrite=overwrite
    )
    if ended == "stopped":
        raise typer.Exit(INTERRUPTED)


register(app)  # evaluate, tables


@dataset.command("build")
def dataset_build(
    photos: Annotated[
        Path, typer.Option(metavar="FOLDER|COCO.json", help="Photos, with subfolders; or COCO annotations.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder; a build in it goes on.")],
    images: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Where a COCO JSON's photos lie; default: beside it.")
    ] = None,
    sample: Annotated[int | None, typer.Option(help="So many photos, chosen at random; default: all.")] = None,
    seed: Annotated[int, typer.Option(help="Of the choice and of the paths.")] = 0,
    base: Annotated[str, typer.Option(help="What turns a photo into Gaussians: sharp or rgbd.")] = "sharp",
    depth: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Depth maps named as the photos, for --base rgbd.")
    ] = None,
    checkpoint: Annotated[Path | None, typer.Option("-c", "--checkpoint", help="Weights of the base.")] = None,
    precision: Annotated[PrecisionChoice, typer.Option(help="Of the base's network.")] = PrecisionChoice.auto,
    views: Annotated[int, typer.Option(help="Views of a photo, its own among them.")] = 20,
    trajectory: Annotated[Trajectory | None, typer.Option(help="Camera path; default: drawn for each photo.")] = None,
    disparity: Annotated[
        tuple[float, float], typer.Option(metavar="LO HI", help="How far the camera moves, drawn between these.")
    ] = (0.1, 0.6),
    inpainter: Annotated[
        InpainterChoice, typer.Option(help="What completes the views; none leaves the holes.")
    ] = InpainterChoice.geometry,
    inpainter_weights: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Weights of propainter: three .pth files.")
    ] = None,
    inpainter_side: Annotated[
        int | None, typer.Option(help="Long side in pixels at which propainter works; default: 640.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes; each holds its own base.")] = 1,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Workers on a Ray cluster: auto, local, HOST:PORT or ray://HOST:PORT."),
    ] = None,
    threads: Annotated[int, typer.Option(help="Threads of each process; SHARP's last bits depend on them.")] = 2,
    shard_size: Annotated[int, typer.Option(help="Photos of a tar file.")] = 50,
    device: DeviceOption = Device.auto,
    verbose: VerboseOption = False,
) -> None:
    """Build a pseudo-supervised dataset: manifest.json and shard-000000.tar, … (the paper's appendix)."""
    from spackle.jobs.dataset_build import build_dataset
    from spackle.jobs.dataset_options import DatasetOptions, base_options, view_choices
    from spackle.jobs.progress import Reporter

    options = DatasetOptions(
        base=base_options(base, depth, checkpoint, precision.value, device.value),
        choices=view_choices(seed, views, trajectory and trajectory.name, disparity),
        images=images,
        sample=sample,
        inpainter=inpainter.value,
        inpainter_weights=inpainter_weights,
        inpainter_side=inpainter_side,
        workers=workers,
        ray=ray,
        threads=threads,
        shard_size=shard_size,
    )
    if build_dataset(photos, output, options, Reporter(verbose)) == "stopped":
        raise typer.Exit(INTERRUPTED)


@dataset.command("info")
def dataset_info(location: DatasetArgument) -> None:
    """Say what a dataset holds: counts, sizes, holes of each view, configuration."""
    from rich.console import Console

    from spackle.jobs.dataset_look import show_info

    show_info(location, Console(highlight=False))


@dataset.command("verify")
def dataset_verify(location: DatasetArgument) -> None:
    """Read every byte and name each damaged sample; exit code 1 where there is one."""
    from spackle.jobs.dataset_look import verify_dataset
    from spackle.jobs.progress import Reporter

    if verify_dataset(location, Reporter()):
        raise typer.Exit(1)


@dataset.command("preview")
def dataset_preview(
    location: DatasetArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder for the two files.")],
    photos: Annotated[int, typer.Option(help="How many photos.")] = 3,
    views: Annotated[int, typer.Option(help="How many views of each.")] = 6,
) -> None:
    """Write sheet.png (base, mask, target) and trajectory.mp4 (base beside target)."""
    from spackle.jobs.dataset_look import preview_dataset
    from spackle.jobs.progress import Reporter

    preview_dataset(location, output, photos, views, Reporter())


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
