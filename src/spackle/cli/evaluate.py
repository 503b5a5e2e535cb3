"""`spackle evaluate`, `spackle tables`, `spackle figures` and `spackle bench`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from spackle.cli.options import (
    INTERRUPTED,
    DeviceOption,
    JsonOption,
    PrecisionOption,
    SharpOption,
    VerboseOption,
    sharp_speed,
)

UNFIT = re.compile(r"[^\w.-]+")  # characters that are replaced in a folder's name

# Options of both `evaluate` and `bench`.
Limit = Annotated[
    int | None,
    typer.Option(min=1, max=1_000_000, help="Number of images, spread over the dataset."),
]
DatasetName = Annotated[
    str,
    typer.Option(
        metavar="NAME", help="Dataset: middlebury, booster, wildrgbd, tanks, eth3d or llff."
    ),
]
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the unpacked dataset.")]
BaseName = Annotated[
    str, typer.Option(help="sharp, moge, lite, hf:NAME, or rgbd with the dataset's depth.")
]
Checkpoint = Annotated[Path | None, typer.Option("-c", "--checkpoint", help="Weights of the base.")]
Residual = Annotated[
    str | None,
    typer.Option(
        metavar="PATH|initial",
        help="Weights of the residual; default: those in the package, else initial.",
    ),
]
Side = Annotated[
    int | None,
    typer.Option(
        min=16,
        max=8192,
        help="Long side of the views. [default: 1280; near-view: 1536]",
        show_default=False,
    ),
]
Disparity = Annotated[
    str,
    typer.Option(
        metavar="A,B,…",
        help="Disparities of the large views, with commas (default: the paper's S1, S2, S3).",
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        metavar="OUT",
        help="Folder for the results; an unfinished run resumes. [default: named by dataset and protocol]",
    ),
]
Html = Annotated[
    bool, typer.Option("--html", help="Also write report.html, one page with all results.")
]


def evaluate(
    folder: Folder,
    dataset: DatasetName,
    protocol: Annotated[
        Literal["large-view", "near-view"],
        typer.Option(help="Views of wide camera moves, or of second photos."),
    ] = "large-view",
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,…",
            help="Methods, with commas: base, paper, spackle, spackle-scene, initial, dense, inpaint2d, direct-ft.",
        ),
    ] = "base,paper,spackle",
    disparity: Disparity = "0.3,0.4,0.5",
    side: Side = None,
    second_views: Annotated[
        Literal["all", "nearest"],
        typer.Option(help="Near views: all second photos of the scene, or the nearest."),
    ] = "all",
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,…",
            help="Metrics, with commas: clipiqa, niqe, musiq, psnr, ssim, distance, dists, lpips; or none.",
        ),
    ] = None,
    base: BaseName = "sharp",
    checkpoint: Checkpoint = None,
    precision: PrecisionOption = "auto",
    sharp: SharpOption = None,
    residual: Residual = None,
    direct_ft: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Weights of the method direct-ft.")
    ] = None,
    inpainter: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="Inpainter of the method inpaint2d: exemplar, lama, opencv, …"
        ),
    ] = "opencv",
    features: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npz", help="SqueezeNet's weights, for the metric distance."),
    ] = None,
    limit: Limit = None,
    download_metrics: Annotated[
        bool,
        typer.Option(
            "--download-metrics", help="Let pyiqa fetch weights (some are not for commercial use)."
        ),
    ] = False,
    device: DeviceOption = "auto",
    output: Output = None,
    html: Html = False,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Evaluate on a dataset by the paper's protocols: rows.jsonl, tables.md, tables.tex, worst.png, best.png."""
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.evaluate import evaluate as run
    from spackle.paper.evaluation.options import EvaluateOptions, parse_disparities, split_words

    options = EvaluateOptions(
        dataset=dataset,
        root=folder,
        protocol=protocol,
        methods=split_words(methods),
        disparities=parse_disparities(disparity),
        side=side,
        second_views=second_views,
        metrics=None if metrics is None else () if metrics == "none" else split_words(metrics),
        base=BaseSettings(
            name=base,
            checkpoint=checkpoint,
            precision=precision,
            device=device,
            **sharp_speed(sharp),
        ),
        residual=residual,
        direct_ft=direct_ft,
        inpainter=inpainter,
        features=features,
        limit=limit,
        download_metrics=download_metrics,
    )
    results = output or Path(f"evaluation-{dataset}-{protocol}")
    if run(options, results, CommandReporter(verbose, as_json=as_json), html) is None:
        raise typer.Exit(INTERRUPTED)


def tables(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...", help="Folders that `spackle evaluate` and `spackle bench` wrote."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="T", help="Folder for the files.")
    ],
    html: Html = False,
) -> None:
    """Put several evaluations and benchmarks into the same tables: tables.md and tables.tex."""
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.evaluate import merge_tables

    merge_tables(results, output, CommandReporter(), html)


def figures(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...", help="Folders that `spackle evaluate --disparity 0.6` wrote."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="F", help="Folder for the files.")
    ],
    rows: Annotated[
        int,
        typer.Option(
            min=1, max=100, help="Number of images in a figure, but at least one from each folder."
        ),
    ] = 6,
) -> None:
    """Draw the paper's figures of views: PDF, PNG, and captions in figures.tex."""
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.figures import make_figures

    make_figures(results, rows, output, CommandReporter())


def bench(
    folder: Folder,
    dataset: DatasetName,
    disparity: Disparity = "0.3,0.4,0.5",
    side: Side = None,
    base: BaseName = "sharp",
    checkpoint: Checkpoint = None,
    precision: PrecisionOption = "auto",
    sharp: SharpOption = None,
    residual: Residual = None,
    limit: Limit = None,
    runs: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of timed runs of all steps after the base.")
    ] = 5,
    base_runs: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            help="Number of timed runs of the base. [default: 1 for sharp, else as --runs]",
        ),
    ] = None,
    device: DeviceOption = "auto",
    output: Output = None,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Count the Gaussians and measure the time that Spackle adds to a base: rows.jsonl, bench.md, bench.tex."""
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.bench import bench as run
    from spackle.paper.evaluation.options import BenchOptions, parse_disparities

    options = BenchOptions(
        dataset=dataset,
        root=folder,
        disparities=parse_disparities(disparity),
        side=side,
        base=BaseSettings(
            name=base,
            checkpoint=checkpoint,
            precision=precision,
            device=device,
            **sharp_speed(sharp),
        ),
        residual=residual,
        limit=limit,
        runs=runs,
        base_runs=base_runs,
    )
    results = output or Path(f"bench-{dataset}-{UNFIT.sub('-', base)}")
    if run(options, results, CommandReporter(verbose, as_json=as_json)) is None:
        raise typer.Exit(INTERRUPTED)
