"""`spackle dataset`: build, info, verify, preview."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    DATASET_BASES,
    INPAINTERS,
    INTERRUPTED,
    DepthKindOption,
    DepthUnitOption,
    DeviceOption,
    PrecisionOption,
    RayOption,
    VerboseOption,
    WorkersOption,
)
from spackle.runtime.declared_options import KeptFiles, SharpTrajectory

dataset = typer.Typer(
    help="Build and inspect training data: views with holes, and targets.", no_args_is_help=True
)


DatasetArgument = Annotated[
    str, typer.Argument(metavar="DATASET", help="A folder, or an address (s3://…).")
]
DatasetsArgument = Annotated[
    list[str], typer.Argument(metavar="DATASET...", help="Folders, or addresses (s3://…).")
]


@dataset.command("build")
def dataset_build(
    *,
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|LIST",
            help="Photos, with subfolders; or a list: COCO annotations (.json), one path a line "
            "(.txt), or a manifest (.jsonl); see docs/dataset.md.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="The dataset's folder; an unfinished build is resumed.",
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder where a list's paths begin; default: the list's own."
        ),
    ] = None,
    sample: Annotated[
        int | None,
        typer.Option(
            min=1, max=1_000_000, help="Number of photos, chosen at random; default: all."
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0, max=2**31 - 1, help="Seed of the random choice of photos and camera paths."
        ),
    ] = 0,
    base: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"What turns a photo into Gaussians: {DATASET_BASES}."),
    ] = "sharp",
    depth: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Depth maps with the photos' names, for --base rgbd."),
    ] = None,
    depth_kind: DepthKindOption = "auto",
    depth_unit: DepthUnitOption = None,
    checkpoint: Annotated[
        Path | None, typer.Option("-c", "--checkpoint", help="Weights of the base.")
    ] = None,
    precision: PrecisionOption = "auto",
    views: Annotated[
        int,
        typer.Option(
            min=2, max=100, help="Number of views of each photo, including the photo's camera."
        ),
    ] = 20,
    trajectory: Annotated[
        SharpTrajectory | None,
        typer.Option(help="Camera path; default: a random path for each photo."),
    ] = None,
    disparity: Annotated[
        tuple[float, float],
        typer.Option(
            metavar="LO HI", help="Smallest and greatest disparity of the random camera paths."
        ),
    ] = (0.1, 0.6),
    inpainter: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help=f"What completes the views: {INPAINTERS}; geometry; none.",
        ),
    ] = "exemplar",
    inpainter_weights: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", help="Weights of the inpainter: propainter's folder, or lama's file."
        ),
    ] = None,
    inpainter_side: Annotated[
        int | None,
        typer.Option(
            help="Long side in pixels at which the inpainter works; default: propainter 640, "
            "lama 1024."
        ),
    ] = None,
    workers: WorkersOption = None,
    threads: Annotated[
        int,
        typer.Option(
            min=1, max=1024, help="Threads of each process; the number changes SHARP's last bits."
        ),
    ] = 2,
    ray: RayOption = None,
    shard_size: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Number of photos in a tar file.")
    ] = 50,
    keep: Annotated[
        KeptFiles,
        typer.Option(
            help="targets: leave out what the photo's Gaussians give again; training reads the "
            "same from a fraction of the pictures."
        ),
    ] = "all",
    device: DeviceOption = "auto",
    verbose: VerboseOption = False,
) -> None:
    """Build a pseudo-supervised dataset: manifest.json and shard-000000.tar, ….

    The paper's appendix describes it.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.paper.dataset.build import build_dataset
    from spackle.paper.dataset.options import DatasetOptions

    # The base makes the views with holes; the inpainter makes from them what training aims at.
    settings = BaseSettings(
        name=base,
        depth=depth,
        depth_kind=depth_kind,
        depth_unit=depth_unit,
        checkpoint=checkpoint,
        precision=precision,
        device=device,
    )
    options = DatasetOptions(
        base=settings,
        images=images,
        sample=sample,
        seed=seed,
        views=views,
        trajectory=trajectory,
        disparity=disparity,
        inpainter=inpainter,
        inpainter_weights=inpainter_weights,
        inpainter_side=inpainter_side,
        workers=workers,
        threads=threads,
        ray=ray,
        shard_size=shard_size,
        keep=keep,
    )
    # Ctrl-C or SIGTERM: finished photos are saved, and the same command resumes the build.
    if build_dataset(photos, output, options, CommandReporter(verbose)) == "stopped":
        raise typer.Exit(INTERRUPTED)


@dataset.command("info")
def dataset_info(locations: DatasetsArgument) -> None:
    """Print counts, sizes, holes of each view, and configuration of datasets."""
    # Imported here, because the help must not wait for torch.
    from rich.console import Console

    from spackle.paper.dataset.inspect import show_info

    for location in locations:
        show_info(location, Console(highlight=False))


@dataset.command("verify")
def dataset_verify(locations: DatasetsArgument) -> None:
    """Read every byte and name each damaged sample; exit code 1 if any is damaged.

    Of several datasets it also says whether training can take them as one.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.dataset.inspect import verify_datasets

    # The problems have been named already; scripts see the exit code.
    if verify_datasets(locations, CommandReporter()):
        raise typer.Exit(1)


@dataset.command("preview")
def dataset_preview(
    location: DatasetArgument,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="OUT", help="Folder for the sheet and the video."),
    ],
    photos: Annotated[int, typer.Option(min=1, help="Number of photos.")] = 3,
    views: Annotated[int, typer.Option(min=1, help="Number of views of each photo.")] = 6,
) -> None:
    """Write sheet.png (base, mask, target) and trajectory.mp4 (base beside target)."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.paper.dataset.inspect import preview_dataset

    preview_dataset(location, output, photos, views, CommandReporter())
