"""Run the command line within this process."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import pytest

from spackle import cli
from spackle.results.results_file import RESULTS_NAME

SHORT = ("--frames", "3")
FILES = {"scene.ply", "video.mp4", "report.json"}


@dataclasses.dataclass(frozen=True)
class Run:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        return self.err.splitlines()


def run(*arguments: object) -> Run:
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", ["spackle", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
    assert isinstance(code, int)
    return Run(code, out.getvalue(), err.getvalue())


def page_of(command: Sequence[object], **options: Any) -> bytes:
    """The page that `spackle view` shows; `options` are those of Popen."""
    server = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True, **options)
    try:
        assert server.stderr is not None
        deadline, found = time.monotonic() + 120, None
        while found is None and time.monotonic() < deadline:
            found = re.search(r"http://127\.0\.0\.1\S+", server.stderr.readline())
        assert found
        with urllib.request.urlopen(found[0], timeout=60) as answer:
            return bytes(answer.read())
    finally:
        server.terminate()
        server.communicate(timeout=60)


def report_of(folder: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return report


def timeless_results(folder: Path) -> list[dict[str, Any]]:
    """The lines of results.jsonl without times, and without what changes with them."""
    lines = []
    for text in (folder / RESULTS_NAME).read_text().splitlines():
        line = json.loads(text)
        assert line.pop("seconds") >= 0
        line.pop("state", None)  # has times of files
        # The report has times, whose digits count.
        assert line.get("files", {"report.json": 1000}).pop("report.json") > 0
        lines.append(line)
    return lines


def names_in(folder: Path) -> set[str]:
    return set(os.listdir(folder))


def predicted(photo: Path, depth: Path, out: Path, *options: object) -> Run:
    """Run `spackle predict` successfully, for three frames or for the views of --cameras."""
    short = () if "--cameras" in options else SHORT
    result = run("predict", photo, "--depth", depth, "-o", out, *short, *options)
    assert result.code == 0, result.err
    return result


def refuses(result: Run, *named: object) -> None:
    """Check that a command failed with one line that contains `named`."""
    assert (result.code, result.out, len(result.lines)) == (2, "", 1), result.err
    assert result.lines[0].startswith("error: ")
    for name in named:
        assert str(name) in result.lines[0]


def decode(video: Path) -> list[av.VideoFrame]:
    with av.open(str(video)) as container:
        return list(container.decode(video=0))
