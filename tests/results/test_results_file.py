"""results.jsonl has one line for each photo, in their order, also after a kill."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from spackle.results.results_file import RESULTS_NAME, ResultsFile

NAMES = ["c", "a/b", "a"]


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / RESULTS_NAME).read_text().splitlines()]


def test_lines_come_as_photos_are_done_and_end_in_the_order_of_the_photos(tmp_path: Path) -> None:
    with ResultsFile(tmp_path, NAMES) as results:
        assert results.line_of(0) == {}
        results.add(2, {"name": "a", "status": "ok"})
        results.add(0, {"name": "c", "status": "failed", "error": "é: no photo"})
        # Who looks into the file meanwhile sees both.
        assert [line["name"] for line in lines(tmp_path)] == ["a", "c"]
        results.add(0, {"name": "c", "status": "ok"})
        assert results.line_of(0)["status"] == "ok"
    assert lines(tmp_path) == [{"name": "c", "status": "ok"}, {"name": "a", "status": "ok"}]


def test_a_file_without_lines_is_not_made_and_a_sorted_one_not_written_again(
    tmp_path: Path,
) -> None:
    with ResultsFile(tmp_path, NAMES):
        pass
    assert list(tmp_path.iterdir()) == []
    with ResultsFile(tmp_path, NAMES) as results:
        results.add(0, {"name": "c"})
        results.add(1, {"name": "a/b"})
    written = (tmp_path / RESULTS_NAME).stat()
    with ResultsFile(tmp_path, NAMES) as results:
        assert results.line_of(1) == {"name": "a/b"}
    read = (tmp_path / RESULTS_NAME).stat()
    assert (read.st_ino, read.st_mtime_ns) == (written.st_ino, written.st_mtime_ns)


def test_a_killed_run_and_an_earlier_one_of_other_photos_lose_no_line(tmp_path: Path) -> None:
    whole = b'{"name": "old"}\n{"name": "a", "status": "failed"}\nno JSON\n["a"]\n{"name": 3}\n'
    (tmp_path / RESULTS_NAME).write_bytes(whole + b'{"name": "c", "sta')  # half a line
    with ResultsFile(tmp_path, NAMES) as results:
        assert results.line_of(0) == {}
        assert results.line_of(2) == {"name": "a", "status": "failed"}
        results.add(1, {"name": "a/b"})
    assert [line["name"] for line in lines(tmp_path)] == ["old", "a/b", "a"]


def test_a_stopped_run_has_its_lines_in_order(tmp_path: Path) -> None:
    def stopped_run() -> None:
        with ResultsFile(tmp_path, NAMES) as results:
            results.add(1, {"name": "a/b"})
            results.add(0, {"name": "c"})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped_run()
    assert [line["name"] for line in lines(tmp_path)] == ["c", "a/b"]
