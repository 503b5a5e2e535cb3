"""`spackle predict`, as the command line has it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    CamerasOption,
    ConvergenceOption,
    Device,
    DeviceOption,
    DisparityOption,
    FormatOption,
    FpsOption,
    FramesOption,
    IpdOption,
    JsonOption,
    LoopOption,
    ModeChoice,
    PathOption,
    PrecisionChoice,
    ShowChoice,
    ShowOption,
    SizeOption,
    StereoOption,
    TrajectoryOption,
    VerboseOption,
    chosen_way,
    video_options,
)


def predict(
    photo: Annotated[
        Path, typer.Option("-i", "--input", metavar="PHOTO_OR_FOLDER", help="A photo, a clip, or a folder.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")],
    base: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="What turns the photo into Gaussians. rgbd: its depth; sharp: Apple's network; lite: rough depth by "
            "networks that come along; hf:OWNER/NAME or hf:FOLDER: a depth model of transformers. "
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
    windows: Annotated[
        int | None,
        typer.Option(metavar="N", help="Of sharp: so many of its 35 windows at once. Default: 5, on a GPU all."),
    ] = None,
    compiled: Annotated[
        bool,
        typer.Option(
            "--compile", help="Sharp through torch.compile, on a GPU as one CUDA graph: minutes once, for many photos."
        ),
    ] = False,
    residual: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|seeds|none",
            help="Weights of the residual. seeds: without any; none: base alone. Default: shipped ones, else seeds.",
        ),
    ] = None,
    render: Annotated[bool, typer.Option(help="Write a video.")] = True,
    trajectory: TrajectoryOption = None,
    disparity: DisparityOption = None,
    path: PathOption = None,
    cameras: CamerasOption = None,
    frames: FramesOption = None,
    video_format: FormatOption = None,
    fps: FpsOption = None,
    loop: LoopOption = None,
    size: SizeOption = None,
    show: ShowOption = ShowChoice.color,
    stereo: StereoOption = None,
    ipd: IpdOption = None,
    convergence: ConvergenceOption = None,
    mode: Annotated[
        ModeChoice, typer.Option(help="scene: one set of Gaussians for all views; view: one for each (the paper's).")
    ] = ModeChoice.scene,
    device: DeviceOption = Device.auto,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the photo.")] = None,
    focal_mm: Annotated[float | None, typer.Option(help="Focal length in mm, 35 mm equivalent.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="In a folder: do again what is done already.")] = False,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Turn photos into completed 3D scenes: scene.ply, base.ply, video.mp4 and report.json each.

    A photo alone is enough. With a depth map, or SHARP's weights (`spackle weights get sharp`), geometry is better.
    """
    from spackle.jobs.options import PredictOptions
    from spackle.jobs.predict import predict_all
    from spackle.progress import Reporter

    kind, far = chosen_way(trajectory, disparity, frames, path, cameras)
    options = PredictOptions(
        base=base,
        depth=depth,
        calib=calib,
        checkpoint=checkpoint,
        precision=precision.value,
        low_memory=low_memory,
        windows=windows,
        compiled=compiled,
        residual=residual,
        render=render,
        trajectory=kind,
        disparity=far,
        cameras=cameras,
        path=path,
        frames=frames,
        video=video_options(video_format, fps, loop, size, show, stereo, ipd, convergence),
        mode=mode.value,
        device=device.value,
        focal_px=focal_px,
        focal_mm=focal_mm,
        fov=fov,
        overwrite=overwrite,
    )
    if predict_all(photo, output, options, Reporter(verbose, as_json=as_json)):
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(short_help="Photos, or a clip, to completed scenes and videos")(predict)
