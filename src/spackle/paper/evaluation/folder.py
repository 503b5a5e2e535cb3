"""A folder of results: config.json, images/ with a file for each finished image, and finally rows.jsonl.

config.json holds the options that determine the renders; rows.jsonl exists once all images are done. A killed run
resumes.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.bases.open import BaseError
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.measurements import PROBLEM, Measurement, Run
from spackle.paper.evaluation.table import NOT_RUN
from spackle.runtime.digests import (
    config_differences,
    file_records,
    json_digest,
    matches_records,
    photo_digest,
)
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import remove_half_written, write_atomic, write_json
from spackle.runtime.folders import make_folder
from spackle.runtime.progress import Reporter, catch_stop_signals

CONFIG, ROWS, IMAGES = "config.json", "rows.jsonl", "images"
FORMAT = 3
DAMAGED = "not written by `spackle evaluate` or `spackle bench` ({reason}): run the command again"
# From index and case to the case's rows and written files.
Measure = Callable[[int, Case], tuple[list[Measurement], list[Path]]]


def write_rows(rows: Iterable[Measurement], path: Path) -> None:
    """Write rows atomically, one JSON object per line."""
    lines = (json.dumps(row._asdict(), allow_nan=False) + "\n" for row in rows)
    write_atomic(path, "".join(lines).encode())


def load_run(folder: Path) -> Run:
    """Read the finished results in a folder; InputError for missing results or a damaged file."""
    if not (folder / ROWS).is_file():
        state = (
            "not finished: run its command again" if (folder / CONFIG).is_file() else "no results"
        )
        raise InputError(f"{folder}: {state}: {ROWS} is missing")
    with as_input_error(folder / ROWS, DAMAGED):
        rows = [
            Measurement(**json.loads(line))
            for line in (folder / ROWS).read_text("utf-8").splitlines()
        ]
    with as_input_error(folder / CONFIG, DAMAGED):
        config = json.loads((folder / CONFIG).read_text("utf-8"))
        if config.pop("format") != FORMAT:
            raise ValueError("of another version")
        return Run(config, rows, config.pop("about"))


def earlier_metrics(folder: Path) -> list[str]:
    """The metrics that an earlier run in the folder measured."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        metrics = json.loads((folder / CONFIG).read_text("utf-8"))["about"]["metrics"]
        return [name for name, state in metrics.items() if not state.startswith(NOT_RUN)]
    return []


def image_file(output: Path, index: int, name: str, suffix: str) -> Path:
    """The path of the file with an image's rows (.json), or with a picture (.METHOD.webp)."""
    return output / IMAGES / f"{index:05d}-{re.sub(r'[^A-Za-z0-9.-]+', '_', name)[-80:]}{suffix}"


def measure_images(
    cases: Sequence[Case],
    measure: Measure,
    output: Path,
    config: Mapping[str, Any],
    about: Mapping[str, Any],
    root: Path,
    reporter: Reporter,
) -> Run | None:
    """Measure the images that earlier runs in the folder have not finished; returns all results, None after Ctrl-C.

    A finished image is measured again if its photos or `about["metrics"]` have changed. An image that cannot be used
    gives one row with the problem, and the next run tries that image again.

    Raises:
        BaseError: the base would fail for every image.
        InputError: no image could be measured, or the folder holds results of another configuration.
    """
    _open_folder(output, config, about)
    rows: list[Measurement] = []
    begun, failed, digest = (
        False,
        0,
        functools.cache(photo_digest),
    )  # many cases may share a second photo
    with reporter.stage("images") as step, catch_stop_signals(single_process=True) as stop:
        for index, case in enumerate(cases):
            if stop():
                reporter.log("stopped; the same command resumes from here")
                return None
            part = image_file(output, index, case.name, ".json")
            photos = [
                digest(photo) for photo in (case.photo, *(second.photo for second in case.seconds))
            ]
            inputs = json_digest([photos, about.get("metrics")])
            done = _load_part(part, inputs)
            if done is None:
                if index and not begun:
                    reporter.log(f"{output}: going on, {index} of {len(cases)} images are done")
                begun, start = True, time.perf_counter()
                (output / ROWS).unlink(missing_ok=True)  # results are incomplete from now on
                try:
                    done, files = measure(index, case)
                except BaseError:  # every other image would fail too, as when memory is too small
                    raise
                except InputError as error:
                    problem = " ".join(str(error).replace(f"{root}/", "").splitlines())
                    if not problem.startswith(case.name):  # several cases may share a photo
                        problem = f"{case.name}: {problem}"
                    reporter.log(f"passed over: {problem}")
                    rows.append(
                        Measurement(str(config["title"]), case.name, "", "", "", PROBLEM, problem)
                    )
                    failed += 1
                else:
                    content = {
                        "inputs": inputs,
                        "files": file_records(part.parent, files),
                        "rows": done,
                    }
                    write_atomic(part, (json.dumps(content, allow_nan=False) + "\n").encode())
                    reporter.detail(f"  {case.name}: {time.perf_counter() - start:.1f} s")
            rows += done or ()
            step(index + 1, len(cases))
    if failed == len(cases):
        raise InputError(
            f"{root}: none of {len(cases)} images could be measured (the lines above say why)"
        )
    return Run(config, rows, about)


def _open_folder(output: Path, config: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Make a folder for this configuration; InputError if the folder has another configuration."""
    make_folder(output / IMAGES)
    remove_half_written(output, output / IMAGES)
    path, kind = output / CONFIG, config["kind"]
    if path.exists():
        with as_input_error(path, "damaged, or not JSON ({reason}): choose another -o"):
            old = json.loads(path.read_text("utf-8"))
        if not isinstance(old, dict) or (old.pop("format", None), old.get("kind")) != (
            FORMAT,
            kind,
        ):
            raise InputError(f"{path}: not written by `spackle {kind}`: choose another -o")
        old.pop("about", None)
        if lines := config_differences(old, json.loads(json.dumps(config))):
            raise InputError(
                f"{output}: holds results with other options ({'; '.join(lines)}): choose another -o"
            )
    write_json({"format": FORMAT, **config, "about": about}, path)


def _load_part(path: Path, inputs: str) -> list[Measurement] | None:
    """An image's rows from an earlier run; None if files are missing, or the inputs have changed."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads(path.read_text("utf-8"))
        whole = not content["files"] or matches_records(path.parent, path.name, content["files"])
        if whole and content["inputs"] == inputs:
            return [Measurement(*row) for row in content["rows"]]
    return None
