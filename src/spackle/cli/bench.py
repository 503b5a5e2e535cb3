"""`spackle bench`: measure what Spackle costs, in Gaussians and in time."""

from __future__ import annotations

from typing import Annotated

import typer

from spackle.cli.evaluation_options import (
    BaseNameOption,
    BaseWeightsOption,
    DatasetNameOption,
    DisparitiesOption,
    FolderArgument,
    LimitOption,
    ResidualNetworkOption,
    ResidualOption,
    ResultsOption,
    SideOption,
    results_name,
)
from spackle.cli.options import (
    INTERRUPTED,
    DeviceOption,
    JsonOption,
    PrecisionOption,
    SharpWindowsOption,
    VerboseOption,
)


def bench(
    folder: FolderArgument,
    dataset: DatasetNameOption,
    disparity: DisparitiesOption = "0.3,0.4,0.5",
    side: SideOption = None,
    base: BaseNameOption = "sharp",
    checkpoint: BaseWeightsOption = None,
    precision: PrecisionOption = "auto",
    sharp_windows: SharpWindowsOption = None,
    residual: ResidualOption = None,
    residual_network: ResidualNetworkOption = None,
    limit: LimitOption = None,
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
    output: ResultsOption = None,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Count the Gaussians and measure the time that Spackle adds to a base.

    Writes rows.jsonl, bench.md and bench.tex.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.paper.evaluation.bench import bench as run_bench
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
            windows_per_batch=sharp_windows,
        ),
        residual=residual,
        residual_network=residual_network,
        limit=limit,
        runs=runs,
        base_runs=base_runs,
    )
    results = output or results_name("bench", dataset, base)
    # No result comes back from a run that the user has stopped.
    if run_bench(options, results, CommandReporter(verbose, as_json=as_json)) is None:
        raise typer.Exit(INTERRUPTED)
