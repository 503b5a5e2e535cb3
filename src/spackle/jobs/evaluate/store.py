"""A folder of figures: one file for each finished part, so that a killed run goes on where it stopped."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spackle.errors import InputError
from spackle.evaluation.results import Record, Run
from spackle.formats import atomic_path
from spackle.jobs.inputs import make_folder, remove_half_written
from spackle.pseudo.manifest import differences

IMAGES = "images"
CONFIG, RESULTS, TIMES = "config.json", "results.json", "times.json"
MARKDOWN, LATEX, WORST, BEST = "tables.md", "tables.tex", "worst.png", "best.png"
FORMAT = 1
KINDS = {  # of a configuration: the command, and what its folder holds
    None: ("evaluate", "an evaluation"),
    "bench": ("bench", "a benchmark"),
    "suite": ("bench --suite", "a suite"),
}


def begin(output: Path, config: Mapping[str, Any], parts: str = IMAGES) -> None:
    """Make the folder this configuration's, or check that it is.

    Args:
        output: the folder.
        config: its "kind" says whose results there are, see `KINDS`.
        parts: the folder in it for what is finished.

    Raises:
        InputError: it holds another one, and says where they differ.
    """
    make_folder(output / parts)
    remove_half_written(output, output / parts)
    path, kind = output / CONFIG, config.get("kind")
    if not path.exists():
        write_json({"format": FORMAT, **config}, path)
        return
    command, results = KINDS[kind]
    old = read_json(path)
    if not isinstance(old, dict) or old.pop("format", None) != FORMAT or old.get("kind") != kind:
        raise InputError(f"{path}: not of `spackle {command}`: choose another -o")
    if lines := differences(old, json.loads(json.dumps(config))):
        raise InputError(f"{output}: holds {results} of another kind ({'; '.join(lines)}): choose another -o")


def stem_of(index: int, name: str) -> str:
    """What an image's files are called."""
    return f"{index:05d}-{re.sub(r'[^A-Za-z0-9.-]+', '_', name)[-80:]}"


def save_record(record: Record, photo: str, seconds: float, path: Path) -> None:
    """Write what became of an image, with the digest of its files."""
    write_json({"inputs": photo, "seconds": seconds, "record": record.plain()}, path)


def load_record(path: Path, photo: str) -> tuple[Record, float] | None:
    """What an earlier run found, and how long it took; None where it is not there, or about other files."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["inputs"] != photo:
            return None
        return Record.of(content["record"]), float(content["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def load_run(folder: Path) -> Run:
    """The finished results in a folder.

    Raises:
        InputError: there are none.
    """
    path = folder / RESULTS
    if not path.is_file():
        state = "not finished: run its command again" if (folder / CONFIG).is_file() else "no results of an evaluation"
        raise InputError(f"{folder}: {state}: {RESULTS} is missing")
    return Run.of(read_json(path), str(path))


def read_json(path: Path) -> Any:
    """InputError where a file is not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read: it is damaged, or not JSON: choose another folder") from error


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Whole or not at all; the same content gives the same bytes."""
    write_text(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", path)


def write_text(text: str, path: Path) -> None:
    """Whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
