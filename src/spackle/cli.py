"""The command line: one thin function a command."""

from __future__ import annotations

import os
import sys
from enum import Enum
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from typer.exceptions import TyperException

from spackle.cli_dataset import dataset
from spackle.cli_evaluate import register
from spackle.cli_options import INTERRUPTED, Device, DeviceOption, PrecisionChoice, Trajectory, VerboseOption
from spackle.cli_weights import weights
from spackle.errors import InputError

app = typer.Typer(
    name="spackle",
    help="One photo in, a 3D Gaussian scene out that survives a large camera move.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class MethodChoice(str, Enum):
    """What learns."""

    residual = "residual"
    direct_ft = "direct-ft"
    lite = "lite"


class ModeChoice(str, Enum):
    """One scene for all views, or the paper's Gaussians for each view."""

    scene = "scene"
    view = "view"


TrajectoryOption = Annotated[Trajectory, typer.Option(help="Camera path of the video.")]
DisparityOption = Annotated[float, typer.Option(help="How far the camera moves: 0 to 2; 0.3 is large.")]
CamerasOption = Annotated[
    Path | None, typer.Option(metavar="FILE.json", help="Exactly these views in place of a path.")
]
FramesOption = Annotated[int, typer.Option(help="Frames of the path.")]


@app.command()
def predict(
    photo: Annotated[Path, typer.Option("-i", "--input", metavar="PHOTO_OR_FOLDER", help="A photo, or a folder.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")],
    base: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="What turns the photo into Gaussians. rgbd: its depth; sharp: Apple's network; lite: rough depth by a "
            "network that comes along; hf:OWNER/NAME or hf:FOLDER: a depth model of transformers. "
            "auto: the depth that is given or in the photo, else sharp if its weights are here, else lite.",
        ),
    ] = "auto",
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH_OR_FOLDER",
            help="Depth of the photo: .npy, .npz, .pfm (metres), 16-bit .png (mm), or Middlebury disparity.",
        ),
    ] = None,
    calib: Annotated[
        Path | None, typer.Option(metavar="FILE", help="calib.txt of a disparity map that lies elsewhere.")
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option("-c", "--checkpoint", metavar="FILE", help="Weights of sharp (or auto), or of lite.")
    ] = None,
    precision: Annotated[
        PrecisionChoice, typer.Option(help="Of sharp and hf; auto: bf16 where the hardware multiplies it.")
    ] = PrecisionChoice.auto,
    low_memory: Annotated[bool, typer.Option("--low-memory", help="Take less memory for sharp.")] = False,
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
    """Turn photos into completed 3D scenes: scene.ply, base.ply, video.mp4 and report.json each.

    A photo alone is enough. With a depth map, or SHARP's weights (`spackle weights get sharp`), geometry is better.
    """
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
        MethodChoice,
        typer.Option(help="What learns: the residual; direct-ft: SHARP's decoder, for comparison; lite: its network."),
    ] = MethodChoice.residual,
    checkpoint: Annotated[
        Path | None, typer.Option("-c", "--checkpoint", metavar="FILE", help="Weights of SHARP, for direct-ft.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start anew where OUT holds a run.")] = False,
    verbose: VerboseOption = False,
) -> None:
    """Train the residual, SHARP itself or lite: best.safetensors, last.safetensors, run.json, pictures and logs."""
    from spackle.jobs.progress import Reporter
    from spackle.jobs.train import train_recipe

    speaker, choices = Reporter(verbose), overrides or []
    ended = train_recipe(
        recipe, choices, output, speaker, method=method.value, checkpoint=checkpoint, overwrite=overwrite
    )
    if ended == "stopped":
        raise typer.Exit(INTERRUPTED)


register(app)  # evaluate, tables, bench
app.add_typer(weights, name="weights")
app.add_typer(dataset, name="dataset")


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
