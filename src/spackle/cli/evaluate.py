"""`spackle evaluate`: evaluate on a dataset by the paper's protocols."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from spackle.cli.evaluation_options import (
    BaseNameOption,
    BaseWeightsOption,
    DatasetNameOption,
    DisparitiesOption,
    FolderArgument,
    HtmlOption,
    LimitOption,
    ResidualNetworkOption,
    ResidualOption,
    ResultsOption,
    SideOption,
    results_name,
)
from spackle.cli.options import (
    INPAINTERS,
    INTERRUPTED,
    METHODS,
    METRICS,
    DeviceOption,
    JsonOption,
    PrecisionOption,
    RayOption,
    SharpWindowsOption,
    ThreadsOption,
    VerboseOption,
    WorkersOption,
)


def evaluate(
    folder: FolderArgument,
    dataset: DatasetNameOption,
    protocol: Annotated[
        Literal["large-view", "near-view"],
        typer.Option(help="Views of wide camera moves, or of second photos."),
    ] = "large-view",
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,…",
            help=f"Methods, with commas: {METHODS}, or package.module:Name.",
        ),
    ] = "base,paper-initial,paper,spackle",
    disparity: DisparitiesOption = "0.3,0.4,0.5",
    side: SideOption = None,
    second_views: Annotated[
        Literal["auto", "adjacent", "nearest", "spread", "all"],
        typer.Option(
            help="Near views: neighbouring frames, the nearest three photos, eight spread from "
            "near to far, or all of the scene. auto: adjacent for wildrgbd, else spread."
        ),
    ] = "auto",
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,…",
            help=f"Metrics, with commas: {METRICS}; or none.",
        ),
    ] = None,
    base: BaseNameOption = "sharp",
    checkpoint: BaseWeightsOption = None,
    precision: PrecisionOption = "auto",
    sharp_windows: SharpWindowsOption = None,
    residual: ResidualOption = None,
    residual_network: ResidualNetworkOption = None,
    direct_ft: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Weights of the method direct-ft.")
    ] = None,
    dense_residual: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Weights of the method dense, if not those of the residual."
        ),
    ] = None,
    inpainter: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"Inpainter of the method inpaint2d: {INPAINTERS}."),
    ] = "opencv",
    features: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="SqueezeNet's weights, for the metric distance, if not downloaded.",
        ),
    ] = None,
    limit: LimitOption = None,
    download_metrics: Annotated[
        bool,
        typer.Option(
            "--download-metrics", help="Let pyiqa fetch weights (some are not for commercial use)."
        ),
    ] = False,
    device: DeviceOption = "auto",
    workers: WorkersOption = None,
    threads: ThreadsOption = None,
    ray: RayOption = None,
    output: ResultsOption = None,
    html: HtmlOption = False,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Evaluate on a dataset by the paper's protocols.

    Writes rows.jsonl, tables.md, tables.tex, worst.png and best.png.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.evaluate import evaluate as run_evaluation
    from spackle.paper.evaluation.options import EvaluateOptions, parse_disparities, split_words

    # None stands for the protocol's own metrics; the word "none" asks for no metric at all.
    metric_names: tuple[str, ...] | None = None
    if metrics is not None:
        metric_names = () if metrics == "none" else split_words(metrics)
    options = EvaluateOptions(
        dataset=dataset,
        root=folder,
        protocol=protocol,
        methods=split_words(methods),
        disparities=parse_disparities(disparity),
        side=side,
        second_views=second_views,
        metrics=metric_names,
        base=BaseSettings(
            name=base,
            checkpoint=checkpoint,
            precision=precision,
            device=device,
            windows_per_batch=sharp_windows,
        ),
        residual=residual,
        residual_network=residual_network,
        direct_ft=direct_ft,
        dense_residual=dense_residual,
        inpainter=inpainter,
        features=features,
        limit=limit,
        download_metrics=download_metrics,
        workers=workers,
        threads=threads,
        ray=ray,
    )
    # The folder has the protocol in its name, so that runs of both protocols do not meet in it.
    results = output or results_name("evaluation", dataset, protocol)
    # No result comes back from a run that the user has stopped.
    if run_evaluation(options, results, CommandReporter(verbose, as_json=as_json), html) is None:
        raise typer.Exit(INTERRUPTED)
