"""`spackle predict FOLDER --workers N` writes the same files as one process, even after a kill."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.command import SHORT, Run, names_in, report_of, run, timeless_results
from helpers.photos import HEIGHT, WIDTH, metres, write_depth, write_photo
from helpers.systems import needs_posix_signals

FILES = {"scene.ply", "report.json", "video.gif"}  # x264 may encode otherwise each time


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three photos and their depth, of which one is no photo; what they become one by one."""
    folder = tmp_path_factory.mktemp("many")
    for index, name in enumerate("abc"):
        size = WIDTH + 8 * index, HEIGHT
        write_photo(folder / "photos" / f"{name}.png", *size)
        write_depth(folder / "depth" / f"{name}.npy", metres(*size))
    (folder / "photos" / "b.png").write_text("not a photo")
    assert predict(folder, folder / "alone").code == 1
    return folder


def predict(place: Path, out: Path, *options: object) -> Run:
    given = (
        place / "photos",
        "--depth",
        place / "depth",
        "-o",
        out,
        "--threads",
        1,
        "--format",
        "gif",
        "--json",
    )
    return run("predict", *given, *SHORT, *options)


def content(out: Path) -> Iterator[Any]:
    """All files; of reports and of results.jsonl all but times, states and the sizes of reports."""
    yield from timeless_results(out)
    for folder in sorted(path for path in out.iterdir() if path.is_dir()):
        assert names_in(folder) == FILES
        report = report_of(folder)
        assert report.pop("seconds")["total"] > 0
        yield (
            folder.name,
            report,
            *((folder / name).read_bytes() for name in sorted(FILES - {"report.json"})),
        )


def test_two_workers_give_the_same_files_as_one_by_one_and_go_on(
    place: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = predict(place, out, "--workers", 2)
    assert (done.code, done.lines[-1]) == (1, "1 of 3 photos failed"), done.err
    assert list(content(out)) == list(content(place / "alone"))
    results = [json.loads(line) for line in done.out.splitlines()]
    assert {Path(result["folder"]).name: "error" in result for result in results} == {
        "a": False,
        "b": True,
        "c": False,
    }
    (out / "c" / "report.json").unlink()
    times = {name: (out / name / "scene.ply").stat().st_mtime_ns for name in "ac"}
    again = predict(place, out, "--workers", 2)
    assert "1 of 3 photos done already (--overwrite does them again)" in again.lines
    assert [(out / name / "scene.ply").stat().st_mtime_ns > times[name] for name in "ac"] == [
        False,
        True,
    ]
    assert list(content(out)) == list(content(place / "alone"))


@needs_posix_signals
@pytest.mark.parametrize(
    ("everybody", "code", "says"),
    [
        (False, 2, "a worker process died"),
        (True, 130, "stopped; the same command resumes from here\ninterrupted"),
    ],
)
def test_killed_workers_are_a_line_and_the_same_command_goes_on(
    place: Path, tmp_path: Path, everybody: bool, code: int, says: str
) -> None:
    out = tmp_path / "out"

    def kill() -> None:
        deadline = time.monotonic() + 240
        while not list(out.glob("*/.new")) and time.monotonic() < deadline:
            time.sleep(0.002)
        if not everybody:
            multiprocessing.active_children()[0].kill()
            return
        os.kill(os.getpid(), signal.SIGTERM)  # as a scheduler ends a job
        for child in multiprocessing.active_children():
            child.terminate()

    killer = threading.Thread(target=kill)
    killer.start()
    done = predict(place, out, "--workers", 2)
    killer.join()
    assert done.code == code
    assert says in "\n".join(done.lines[-2:])
    assert ".lock" not in names_in(out)
    assert predict(place, out).code == 1
    assert list(content(out)) == list(content(place / "alone"))
