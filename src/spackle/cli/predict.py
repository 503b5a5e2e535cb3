"""`spackle predict` and `spackle demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from spackle.cli.options import (
    CheckpointOption,
    DeviceOption,
    InputOption,
    JsonOption,
    KeepFrameOption,
    PrecisionName,
    SharpOption,
    VerboseOption,
    given_input,
    sharp_speed,
    with_path_options,
)

if TYPE_CHECKING:
    from spackle.views import PathOptions


@with_path_options
def predict(
    *,
    photo: Annotated[
        Path | None, typer.Argument(metavar="PHOTO", help="A photo, a clip, or a folder of photos.", show_default=False)
    ] = None,
    given: InputOption = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Results go to OUT/PHOTO_NAME/.")
    ] = Path("out"),
    base: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="What turns the photo into Gaussians. rgbd: its depth; sharp: Apple's network; depth: "
            "Depth-Anything-V2-Small; lite: rough depth by networks that come along; hf:OWNER/NAME or hf:FOLDER: "
            "another depth model of transformers. auto: the depth that is given or in the photo, else sharp, else "
            "depth, if `spackle weights get` brought them, else lite.",
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
        Path | None, typer.Option(hidden=True, metavar="FILE", help="calib.txt of a disparity map that lies elsewhere.")
    ] = None,
    checkpoint: CheckpointOption = None,
    precision: Annotated[
        PrecisionName, typer.Option(hidden=True, help="Of sharp and hf; auto: bf16 where the hardware multiplies it.")
    ] = "auto",
    sharp: SharpOption = None,
    residual: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|seeds|none",
            hidden=True,
            help="Weights of the residual. seeds: without any; none: base alone. Default: shipped ones, else seeds.",
        ),
    ] = None,
    fill: Annotated[
        Literal["auto", "network", "exemplar", "lama", "none"],
        typer.Option(
            help="Texture of what fills the holes. lama: its inpainting (`spackle weights get lama`); exemplar: of the "
            "photo itself; network: none. none: holes stay open. auto: lama if its weights are here, else exemplar."
        ),
    ] = "auto",
    render: Annotated[bool, typer.Option(help="Write a video.")] = True,
    path: PathOptions,
    mode: Annotated[
        Literal["scene", "view"],
        typer.Option(hidden=True, help="scene: one set of Gaussians for all views; view: one for each (the paper's)."),
    ] = "scene",
    device: DeviceOption = "auto",
    focal_px: Annotated[float | None, typer.Option(hidden=True, help="Focal length in pixels of the photo.")] = None,
    focal_mm: Annotated[float | None, typer.Option(help="Focal length in mm, 35 mm equivalent.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    keep_frame: KeepFrameOption = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="In a folder: do again what is done already.")] = False,
    workers: Annotated[
        int,
        typer.Option(
            hidden=True, help="In a folder: photos at once, each in a process that holds the base's network itself."
        ),
    ] = 1,
    threads: Annotated[
        int | None,
        typer.Option(
            hidden=True,
            help="Threads of each worker; networks' last bits depend on them.",
            show_default="the cores, shared evenly; with --ray 2",
        ),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", hidden=True, help="Workers on a Ray cluster, as `dataset build`.")
    ] = None,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Turn photos into completed 3D scenes: scene.ply, base.ply, video.mp4 and report.json each.

    A photo alone is enough. A depth map, or what `spackle weights get depth` or `sharp` fetches, gives better geometry.
    """
    from spackle.bases.settings import BaseSettings
    from spackle.cli.photo import PredictOptions
    from spackle.cli.photos import predict_all
    from spackle.pipeline import FillOptions, Options
    from spackle.progress import Reporter

    settings = BaseSettings(base, depth, calib, checkpoint, precision, device=device, **sharp_speed(sharp))
    options = PredictOptions(
        Options(settings, path, FillOptions(residual, fill, mode)),
        {"focal_px": focal_px, "focal_mm": focal_mm, "fov": fov},
        render=render,
        keep_frame=keep_frame,
        overwrite=overwrite,
        workers=workers,
        threads=threads,
        ray=ray,
    )
    if predict_all(given_input("PHOTO", photo, given), output, options, Reporter(verbose, as_json=as_json)):
        raise typer.Exit(1)


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for the results.")] = Path(
        "demo-output"
    ),
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Complete the Middlebury Motorcycle photo and compare with the true second photo (needs scikit-image)."""
    from spackle.cli.demo import run_demo
    from spackle.progress import Reporter

    run_demo(output, Reporter(verbose, as_json=as_json))
