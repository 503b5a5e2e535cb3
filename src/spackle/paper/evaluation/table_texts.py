"""The names of rows in tables, and the notes below tables.

The notes say what a reader needs for judging the numbers: views, base (the network that turns
photos into Gaussians), methods, weights, definitions of metrics, missing images, machine.
"""

from __future__ import annotations

from collections.abc import Sequence

from spackle.paper.evaluation.case import MAX_SPREAD_VIEWS
from spackle.paper.evaluation.measurements import (
    BASE_PARAMETERS,
    NOTE_PREFIX,
    RESIDUAL_PARAMETERS,
    Run,
)
from spackle.paper.evaluation.method_descriptions import describe_method
from spackle.paper.evaluation.metrics import METRICS, metric_of_column
from spackle.paper.evaluation.paper_numbers import PAPER_PARAMETERS
from spackle.paper.evaluation.table import NOT_RUN
from spackle.paper.evaluation.table_layouts import ColumnLayout, TableLayout

# Marks methods whose residual network was not trained by the paper's recipe.
RECIPE_MARK = "‡"
# What the times of tables include.
TIMED_WORK_NOTE = (
    "Base time: from the photo in memory to its Gaussians, and one rendering of the view. Spackle "
    "time: the base's time, in whose rendering the holes are found, and all that completion adds: "
    "mask, initial Gaussians, the inputs that the network names, the network, and a second "
    "rendering of the view with the added Gaussians. A method that keeps Gaussians behind what "
    "the photo shows also renders the photo's own view. No run uses what another has computed."
)
# Which second photos near views were compared with, by `SecondViews`.
SECOND_VIEWS_TEXTS = {
    "adjacent": "the photos before and after the input in its scene, as neighbouring frames",
    "nearest": "the three nearest other photos of the scene that show the same",
    "spread": (
        f"the scene's other photos; of more than {MAX_SPREAD_VIEWS}, {MAX_SPREAD_VIEWS} spread "
        "from the nearest to the farthest"
    ),
    "all": "all other photos of the scene",
}
NO_NETWORK = "–"  # instead of a number of parameters
MAX_LISTED_IMAGES = 5  # the most names in a note about images that could not be measured


def method_row_name(run: Run, method: str, title: str = "") -> str:
    """The name of a method's row: its title, and in brackets the base that it starts from.

    Args:
        run: the results; they say which base was used, and which weights the residual network had.
        method: the method's name.
        title: a title instead of the method's own.

    Returns:
        For instance "Spackle‡ (SHARP)". The mark ‡ says that the residual network was not trained
        by the paper's recipe: it had the weights that ship with Spackle, or none.
    """
    # The method "base" adds nothing to the base, so naming the base in brackets would repeat it.
    if method == "base":
        return f"{run.base_title} alone"
    description = describe_method(method)
    row_title = title or description.title

    # Only weights that the user gave can come from the paper's recipe.
    has_given_weights = run.config["residual"]["weights"] == "given"
    needs_mark = description.uses_residual and not has_given_weights
    mark = RECIPE_MARK if needs_mark else ""
    return f"{row_title}{mark} ({run.base_title})"


def shown_methods(layout: TableLayout, run: Run) -> dict[str, str]:
    """The methods of a run that have a row in a table, each with the name of its row.

    A layout with `row_titles` names the methods that it shows. Any other layout shows all methods
    of the run, or, with a `needed_metric`, all but the base that were measured by this metric.
    """
    if layout.row_titles is not None:
        return {
            method: method_row_name(run, method, title)
            for method, title in layout.row_titles.items()
            if method in run.methods
        }

    methods = run.methods
    if layout.needed_metric is not None:
        # A method can lack a metric: a flat inpainted picture has no opacity, and so no holes.
        methods_with_metric = {
            measurement.method
            for measurement in run.measurements
            if measurement.metric == layout.needed_metric
        }
        # Such a table shows what methods change about the base, so the base has no row.
        methods = [
            method for method in methods if method in methods_with_metric and method != "base"
        ]
    return {method: method_row_name(run, method) for method in methods}


def missing_columns(layout: TableLayout, runs: Sequence[Run]) -> list[ColumnLayout]:
    """The columns of image metrics that none of a table's runs has measured; they are left out.

    A table that shows no run has all columns, for the paper's numbers.
    """
    if not runs:
        return []
    measured = {measurement.metric for run in runs for measurement in run.measurements}
    return [
        column
        for column in layout.columns
        if metric_of_column(column.metric) is not None and column.metric not in measured
    ]


def caption_of_table(layout: TableLayout, runs: Sequence[Run]) -> str:
    """A table's caption, which also says on which base and which scenes its numbers are from.

    A table may be copied without its notes.
    """
    titles_by_base: dict[str, list[str]] = {}
    for run in runs:
        titles = titles_by_base.setdefault(run.base_title, [])
        if run.title not in titles:
            titles.append(run.title)
    if not titles_by_base:
        return layout.caption
    bases = [f"{base} ({', '.join(titles)})" for base, titles in titles_by_base.items()]
    return f"{layout.caption} Base of our rows: {'; '.join(bases)}."


def notes_of_table(layout: TableLayout, runs: Sequence[Run]) -> list[str]:
    """The notes below a table that shows these runs; a note that runs share is listed once."""
    # Several columns may show one metric, such as PSNR in the hole and outside.
    metrics = [metric_of_column(column.metric) for column in layout.columns]
    image_metrics = list(dict.fromkeys(metric for metric in metrics if metric is not None))
    left_out = {metric_of_column(column.metric) for column in missing_columns(layout, runs)}
    shown_metrics = [metric for metric in image_metrics if metric not in left_out]

    # A table without a column has nothing to explain, but says how to get its metrics.
    if len(left_out) == len(layout.columns):
        missing_notes = [
            note for run in runs for note in _missing_metrics_notes(run, image_metrics)
        ]
        return list(dict.fromkeys(missing_notes))

    notes = [f"{run.title}: {run.about_scenes}." for run in runs if run.about_scenes]
    notes += [_views_note(run) for run in runs]
    notes += [f"Base {run.base_title}: {run.base_description}." for run in runs]
    notes += _methods_notes(layout, runs)
    notes += [_residual_note(run) for run in runs]
    notes += [f"{METRICS[name].name}: {METRICS[name].definition}." for name in shown_metrics]
    for run in runs:
        notes += _missing_metrics_notes(run, image_metrics)
        notes += _missing_images_notes(run)
    for run in runs:
        if run.is_benchmark:
            notes += _timing_notes(run)

    # Runs of several datasets share most notes. The table's own notes come last.
    return [*dict.fromkeys(notes), *layout.notes]


def overview_notes(runs: Sequence[Run]) -> list[str]:
    """Notes below an overview of evaluations: scenes, bases, methods, weights, missing metrics."""
    notes = [f"{run.title}: {run.about_scenes}." for run in runs if run.about_scenes]
    notes += [f"Base {run.base_title}: {run.base_description}." for run in runs]
    descriptions = [describe_method(method) for run in runs for method in run.methods]
    notes += [f"{description.title}: {description.summary}." for description in descriptions]
    notes += [_residual_note(run) for run in runs]
    for run in runs:
        asked_metrics = [name for name in METRICS if name in run.about.get("metrics", {})]
        notes += _missing_metrics_notes(run, asked_metrics)
    return list(dict.fromkeys(notes))


def _views_note(run: Run) -> str:
    """The note that says which views of each image were rendered."""
    if not run.compares_with_photos:
        return (
            "Views: both ends of a swipe at each disparity, where the camera is farthest left and "
            "farthest right and looks at the focus point; "
            f"long side {run.config['side']} pixels."
        )
    photos = SECOND_VIEWS_TEXTS[run.config["second_views"]]
    return f"Views of {run.title}: from the cameras of {photos}."


def _methods_notes(layout: TableLayout, runs: Sequence[Run]) -> list[str]:
    """A note that explains the methods in a table's rows; empty if the table shows no run."""
    # A table may have titles of its own for methods, as in the paper.
    row_titles = layout.row_titles or {}
    explanations = {}
    for run in runs:
        for method in shown_methods(layout, run):
            description = describe_method(method)
            title = row_titles.get(method) or description.title
            explanations[method] = f"{title}: {description.summary}"

    if not explanations:
        return []
    return [f"Rows: {'; '.join(explanations.values())}."]


def _residual_note(run: Run) -> str:
    """The note that says which weights the residual network had."""
    residual = run.config["residual"]
    # The digest tells files of weights apart; if there are no weights, it is None.
    digest_start = str(residual["sha256"])[:8]
    if residual["weights"] == "given":
        return f"Residual: given weights ({digest_start})."

    # The note says what differs from the paper, whose recipe did not make the shipped weights.
    if residual["sha256"]:
        weights = f"the residual has the weights that ship with Spackle ({digest_start})"
    else:
        weights = "the residual has no weights (deltas are 0)"
    return f"{RECIPE_MARK} Not the paper's recipe: {weights}."


def _missing_metrics_notes(run: Run, image_metrics: Sequence[str]) -> list[str]:
    """Notes on the image metrics that a run did not measure, one for each reason."""
    # Benchmarks have no metrics. Metrics with the same reason share a note.
    states = run.about.get("metrics", {})  # by metric, such as "not run: NIQE needs pyiqa"
    names_by_reason: dict[str, list[str]] = {}
    for metric in image_metrics:
        state = str(states.get(metric, f"{NOT_RUN}: not among the chosen `metrics`"))
        if state.startswith(NOT_RUN):
            names_by_reason.setdefault(state, []).append(METRICS[metric].name)
    return [f"{', '.join(names)} {reason}." for reason, names in names_by_reason.items()]


def _missing_images_notes(run: Run) -> list[str]:
    """A note on the images that could not be measured; empty if there are none."""
    missing_images = list(run.problems)
    if not missing_images:
        return []
    # A few names are enough to find the cause; rows.jsonl has them all.
    listed_images = missing_images[:MAX_LISTED_IMAGES]
    if len(missing_images) > MAX_LISTED_IMAGES:
        listed_images.append("…")
    return [
        f"{run.title}: {len(missing_images)} of {len(run.images)} images could not be measured: "
        f"{', '.join(listed_images)}."
    ]


def _timing_notes(run: Run) -> list[str]:
    """Notes on a benchmark: machine and number formats, timed runs, sizes of networks."""
    return [_machine_note(run), TIMED_WORK_NOTE, _timed_runs_note(run), _parameters_note(run)]


def _machine_note(run: Run) -> str:
    """The note on a benchmark's machine, and on the number formats of the networks."""
    # A base with a network stores the network's number format as a note with each image. None: the
    # base has no network.
    base_precision = None
    for measurement in run.measurements:
        if measurement.metric == f"{NOTE_PREFIX}precision":
            base_precision = measurement.value
            break

    # Which number format a network computes in, and where it runs, decides about its speed.
    places = []
    if base_precision:
        base_device = run.config["base"]["device"]
        places.append(f"{run.base_title}'s network in {base_precision} on {base_device}")
    if run.config["residual"]["precision"]:
        places.append(f"residual in {run.config['residual']['precision']}")
    places.append(f"renderer and residual on {run.config['device']}")

    hardware = run.config["hardware"]
    machine = [hardware["cpu"], f"{hardware['cores']} cores", f"{hardware['threads']} threads"]
    if "gpu" in hardware:
        machine.append(hardware["gpu"])

    versions = [f"{package} {version}" for package, version in run.config["versions"].items()]
    return f"Times: {'; '.join(places)}. Machine: {', '.join(machine)}; {', '.join(versions)}."


def _timed_runs_note(run: Run) -> str:
    """The note that says how often a benchmark timed each stage."""
    return (
        f"Each stage: median of {run.config['runs']} runs after an untimed run; the base: "
        f"{run.config['base_runs']} per image. Files are read before the clock starts, and nothing "
        "is written."
    )


def _parameters_note(run: Run) -> str:
    """The note on the numbers of parameters of the networks that ran, and of the paper's."""
    base_count = _fact_of_images(run, BASE_PARAMETERS)
    residual_count = _fact_of_images(run, RESIDUAL_PARAMETERS)
    base_text = _millions(base_count)
    residual_text = _millions(residual_count)

    # A sum and a share need both networks.
    together = ""
    if base_count and residual_count:
        share_percent = 100 * residual_count / base_count
        total = _millions(base_count + residual_count)
        together = f" ({share_percent:.2f} %), together {total}"

    paper = PAPER_PARAMETERS
    return (
        "Parameters in millions, counted in the networks that ran: "
        f"base {run.base_title} {base_text}; residual {residual_text}{together}. The paper: "
        f"{paper.base_m}, {paper.residual_m} ({paper.share_percent} %), together "
        f"{paper.merged_m}; it counts all of SHARP's checkpoint, of which inference uses a part."
    )


def _fact_of_images(run: Run, metric: str) -> float | None:
    """A number that all images of a run share; None if it is unknown."""
    for measurement in run.measurements:
        if measurement.metric == metric and isinstance(measurement.value, int | float):
            return float(measurement.value)
    return None


def _millions(count: float | None) -> str:
    """A number of parameters in millions; "–" without a network."""
    if count is None:
        return "not counted"
    return f"{count / 1e6:.2f}" if count else NO_NETWORK
