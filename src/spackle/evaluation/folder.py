"""A folder of results: config.json, images/ with a file for each finished image, and finally rows.jsonl.

config.json holds the options that determine the renders; rows.jsonl exists once all images are done. A killed run
resumes. If metrics are added to a finished run, only these are measured.
"""

from __future__ import annotations

import functools
import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.bases.open import BaseError
from spackle.errors import InputError, reading
from spackle.evaluation.case import Case
from spackle.evaluation.metrics import METRICS, metric_name
from spackle.evaluation.rows import PROBLEM, REMARK, Row, Run
from spackle.evaluation.table import NOT_RUN
from spackle.files import write_json, write_whole
from spackle.folders import (
    as_recorded,
    differences,
    digest_of,
    file_records,
    make_folder,
    photo_digest,
    remove_half_written,
)
from spackle.progress import Reporter, asked_to_stop

CONFIG, ROWS, IMAGES = "config.json", "rows.jsonl", "images"
FORMAT = 3
KINDS = {"evaluate": "an evaluation", "bench": "a benchmark"}  # by the "kind" in a configuration
DAMAGED = "not of `spackle evaluate` or `spackle bench` ({reason}): run it again"
# From index, case and the metrics to measure, to the case's rows and the files that it wrote.
Measure = Callable[[int, Case, Sequence[str]], tuple[list[Row], list[Path]]]


def write_rows(rows: Iterable[Row], path: Path) -> None:
    """Write rows atomically, one JSON object per line."""
    lines = (json.dumps(row._asdict(), allow_nan=False) + "\n" for row in rows)
    write_whole(path, "".join(lines).encode())


def load_run(folder: Path) -> Run:
    """Read the finished results in a folder; InputError if there are none, or a file is damaged."""
    if not (folder / ROWS).is_file():
        state = "not finished: run its command again" if (folder / CONFIG).is_file() else "no results"
        raise InputError(f"{folder}: {state}: {ROWS} is missing")
    with reading(folder / ROWS, DAMAGED):
        rows = [Row(**json.loads(line)) for line in (folder / ROWS).read_text("utf-8").splitlines()]
        if not all(isinstance(word, str) for row in rows for word in row[:-1]):
            raise ValueError("a name that is no text")
    with reading(folder / CONFIG, DAMAGED):
        config = json.loads((folder / CONFIG).read_text("utf-8"))
        if config.pop("format") != FORMAT:
            raise ValueError("of another version")
        run = Run(config, rows, config.pop("about"))
        _ = (run.title, run.base, run.timed, run.methods, run.settings)  # raises if one is missing
    return run


def open_folder(output: Path, config: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Make a folder for this configuration (its "kind" is in `KINDS`); InputError if it has another one.

    `about` is stored for readers; a run may resume with another one.
    """
    make_folder(output / IMAGES)
    remove_half_written(output, output / IMAGES)
    path, kind = output / CONFIG, config["kind"]
    if not path.exists():
        write_json({"format": FORMAT, **config, "about": about}, path)
        return
    with reading(path, "damaged, or not JSON ({reason}): choose another -o"):
        old = json.loads(path.read_text("utf-8"))
    if not isinstance(old, dict) or old.pop("format", None) != FORMAT or old.get("kind") != kind:
        raise InputError(f"{path}: not of `spackle {kind}`: choose another -o")
    old.pop("about", None)
    if lines := differences(old, json.loads(json.dumps(config))):
        raise InputError(f"{output}: holds {KINDS[kind]} of another kind ({'; '.join(lines)}): choose another -o")


def image_file(output: Path, index: int, name: str, suffix: str) -> Path:
    """The path of the file with an image's rows (.json), or with one of its pictures (.METHOD.webp)."""
    return output / IMAGES / f"{index:05d}-{re.sub(r'[^A-Za-z0-9.-]+', '_', name)[-80:]}{suffix}"


def measure_images(
    cases: Sequence[Case],
    measure: Measure,
    output: Path,
    config: Mapping[str, Any],
    about: Mapping[str, Any],
    root: Path,
    reporter: Reporter,
    metrics: Mapping[str, str] | None = None,
) -> Run | None:
    """Measure the images that earlier runs in the folder have not finished; returns all results, None after Ctrl-C.

    For finished images only new metrics are measured. `metrics` maps each metric to who measures it, or to "not run",
    which keeps the figures of an earlier run. An image that cannot be used gives one row, which names the problem, and
    the next run tries it again.

    Raises:
        BaseError: the base would fail for every image.
        InputError: no image gave figures, or the folder holds results of another configuration.
    """
    open_folder(output, config, about)
    measurable = {name: state for name, state in (metrics or {}).items() if not state.startswith(NOT_RUN)}
    rows: list[Row] = []
    measured: list[dict[str, str]] = []  # for each image with figures, who measured its metrics
    begun, digest = False, functools.cache(photo_digest)  # cached: a photo may be a second photo of many cases
    with reporter.stage("images") as step, asked_to_stop(alone=True) as stop:
        for index, case in enumerate(cases):
            if stop():
                reporter.log("stopped; the same command resumes from here")
                return None
            part = image_file(output, index, case.name, ".json")
            inputs = digest_of([digest(photo) for photo in (case.photo, *(second.photo for second in case.seconds))])
            done = _load_part(part, inputs)
            rows_of_case, states = done or ([], {})
            due = [name for name, state in measurable.items() if states.get(name) != state]
            if done is None or due:
                if index and not begun:
                    reporter.log(f"{output}: going on, {index} of {len(cases)} images are done")
                begun, start = True, time.perf_counter()
                try:
                    new, files = measure(index, case, due)
                except BaseError:  # every other image would fail too, as when memory is too small
                    raise
                except InputError as error:
                    problem = problem_of(case, error, root)
                    reporter.log(f"passed over: {problem}")
                    rows.append(Row(str(config["title"]), case.name, "", "", "", PROBLEM, problem))
                    step(index + 1, len(cases))
                    continue
                rows_of_case = with_metrics(rows_of_case, new, due) if done else with_metrics(new, [], [])
                states |= {name: measurable[name] for name in due}
                seconds = round(time.perf_counter() - start, 3)
                content = {"inputs": inputs, "seconds": seconds, "files": file_records(part.parent, files)}
                content |= {"metrics": states, "rows": rows_of_case}
                write_whole(part, (json.dumps(content, allow_nan=False) + "\n").encode())
                reporter.detail(f"  {case.name}: {seconds:.1f} s")
            rows += rows_of_case
            measured.append(states)
            step(index + 1, len(cases))
    if not measured:
        raise InputError(f"{root}: none of {len(cases)} images gave figures (the lines above say why)")
    found = {name: {states.get(name, NOT_RUN) for states in measured} for states in measured for name in states}
    agreed = {
        name: by.pop() if len(by) == 1 else f"{NOT_RUN}: not by one version on all images" for name, by in found.items()
    }
    about = {**about, "metrics": {**(metrics or {}), **agreed}}
    write_json({"format": FORMAT, **config, "about": about}, output / CONFIG)
    partly = [name for name, state in agreed.items() if state.startswith(NOT_RUN)]
    return Run(config, [row for row in rows if metric_name(row.metric) not in partly], about)


def with_metrics(old: Sequence[Row], new: Sequence[Row], names: Sequence[str]) -> list[Row]:
    """Replace an image's figures of the metrics `names` by new ones; rows are ordered as if measured in one run."""
    order = [*METRICS]

    def about(row: Row) -> str | None:
        return str(row.value).partition(" ")[0] if row.metric == REMARK else metric_name(row.metric)

    def rank(row: Row) -> tuple[bool, int, int]:
        name = metric_name(row.metric)
        return row.metric == REMARK, views[row[2:5]], order.index(name) + 1 if name else 0

    rows = [*(row for row in old if about(row) not in names), *(row for row in new if about(row) in names)]
    views = {view: place for place, view in enumerate(dict.fromkeys(row[2:5] for row in rows))}
    return sorted(rows, key=rank)


def _load_part(path: Path, inputs: str) -> tuple[list[Row], dict[str, str]] | None:
    """Rows and metrics of an image from an earlier run; None if they are incomplete, or photos have changed."""
    try:
        content = json.loads(path.read_text("utf-8"))
        whole = not content["files"] or as_recorded(path.parent, path.name, content["files"])
        if not whole or content["inputs"] != inputs:
            return None
        return [Row(*row) for row in content["rows"]], dict(content["metrics"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def problem_of(case: Case, error: InputError, root: Path) -> str:
    """Why a case is skipped, in one line; it begins with the case's name, because several cases may share a photo."""
    problem = from_root(str(error), root)
    return problem if problem.startswith(case.name) else f"{case.name}: {problem}"


def from_root(problem: str, root: Path) -> str:
    """Make the paths in a message relative to the dataset's folder, and put it into one line."""
    return " ".join(problem.replace(f"{root}/", "").splitlines())
