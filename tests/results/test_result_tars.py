"""Tars of results are whole, have the same bytes after a kill, and are read as WebDataset."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import types
from pathlib import Path
from typing import Any

import pytest
from helpers import flat_base
from helpers.command import Run, names_in, run
from helpers.flat_base import QUICK, write_small_photos
from helpers.systems import needs_posix_signals

import spackle.results.result_tars as result_tars
from spackle.results.result_tars import key_of
from spackle.results.results_file import RESULTS_NAME

NAMES = ("1.png", "2.png", "a/v1.5 é.png", "a/x.png", "b.png")
TARS = ("results-000000.tar", "results-000001.tar", "results-000002.tar")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photos, of which the second is damaged, and what they become."""
    place = tmp_path_factory.mktemp("tars")
    write_small_photos(place / "photos", *NAMES)
    (place / "photos" / "2.png").write_text("no photo")
    assert predict(place, place / "whole").code == 1
    return place


def words(place: Path, out: Path) -> tuple[object, ...]:
    return ("predict", place / "photos", "-o", out, *QUICK, "--recursive", "--tar", 2)


def predict(place: Path, out: Path, *options: object) -> Run:
    return run(*words(place, out), *options)


def lines_of(out: Path) -> list[dict[str, Any]]:
    """The lines of results.jsonl without their times."""
    lines = [json.loads(line) for line in (out / RESULTS_NAME).read_text().splitlines()]
    return [{key: line[key] for key in line if key != "seconds"} for line in lines]


def assert_same(out: Path, whole: Path) -> None:
    assert names_in(out) == {*TARS, RESULTS_NAME}
    for name in TARS:
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    assert lines_of(out) == lines_of(whole)


def test_a_tar_has_the_files_of_its_photos_under_keys_of_webdataset(place: Path) -> None:
    whole = place / "whole"
    assert names_in(whole) == {*TARS, RESULTS_NAME}
    # The bytes are those of files alone: no time, no owner, sorted.
    with tarfile.open(whole / TARS[1]) as tar:
        members = tar.getmembers()
        report = json.load(tar.extractfile(members[0]) or io.BytesIO())
    # The photos' order is that of their names: 1, 2, a/v1.5 é, a/x, b.
    assert [member.name for member in members] == [
        "a/v1%2E5 é.report.json",
        "a/v1%2E5 é.scene.ply",
        "a/x.report.json",
        "a/x.scene.ply",
    ]
    assert {(member.mtime, member.uid, member.gid, member.uname) for member in members} == {
        (0, 0, 0, "")
    }
    assert "seconds" not in report
    with tarfile.open(whole / TARS[0]) as tar:
        assert tar.getnames() == ["1.report.json", "1.scene.ply"]  # photo 2 has failed
    first, second, third, *_ = lines_of(whole)
    assert (first["tar"], third["tar"]) == (TARS[0], TARS[1])
    assert first["files"]["report.json"] > 0
    assert (second["status"], "tar" in second) == ("failed", False)


def test_keys_have_no_dot_and_tell_photos_apart() -> None:
    names = ["a.b/c", "a.b/c.d", "a.b/c%2Ed", "a.b/c_d"]
    assert [key_of(name) for name in names] == ["a.b/c", "a.b/c%2Ed", "a.b/c%252Ed", "a.b/c_d"]


def test_a_rerun_does_nothing_again_and_a_mended_photo_joins_its_tar(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    shutil.copytree(place / "whole", out)
    shutil.copytree(place / "photos", tmp_path / "photos")
    done: list[str] = []
    predict_flat = flat_base.Flat.predict

    def counted(self: Any, photo: Any, progress: Any = None) -> Any:
        done.append(photo.path.name)
        return predict_flat(self, photo, progress)

    monkeypatch.setattr(flat_base.Flat, "predict", counted)
    assert predict(place, out).code == 1
    assert done == []
    assert_same(out, place / "whole")
    # Without results.jsonl, the reports in the tars say what is done.
    (out / RESULTS_NAME).unlink()
    assert predict(place, out).code == 1
    assert done == []
    assert_same(out, place / "whole")

    # A photo that was mended joins the others in its tar.
    shutil.copy(tmp_path / "photos" / "1.png", tmp_path / "photos" / "2.png")
    assert predict(tmp_path, out).code == 0
    assert done == ["2.png"]
    with tarfile.open(out / TARS[0]) as tar:
        assert tar.getnames() == ["1.report.json", "1.scene.ply", "2.report.json", "2.scene.ply"]
    # Photos at the end are added; others would move the photos between the tars.
    write_small_photos(tmp_path / "photos", "c.png")
    assert predict(tmp_path, out).code == 0
    assert done == ["2.png", "c.png"]
    with tarfile.open(out / TARS[2]) as tar:
        assert tar.getnames() == ["b.report.json", "b.scene.ply", "c.report.json", "c.scene.ply"]
    write_small_photos(tmp_path / "photos", "0.png")
    refused = predict(tmp_path, out)
    assert refused.code == 2
    assert "give the same --tar and the same photos" in refused.lines[-1]


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_run_that_ends_around_a_tar_goes_on_with_the_same_bytes(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """The end comes when the first tar is about to be written, or before its folders go."""
    out = tmp_path / "out"

    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if moment == "before":
            patch.setattr(result_tars, "_add_folder", interrupted)
        else:
            patch.setattr(result_tars, "shutil", types.SimpleNamespace(rmtree=interrupted))
        assert predict(place, out).code == 130
    assert (out / TARS[0]).exists() == (moment == "after")
    assert (out / "staging" / "1" / "scene.ply").exists()
    # As kills leave them, while a tar is written and while its folders are removed.
    (out / f".{TARS[0][:-4]}.0123456789ab.tar").touch()
    if moment == "after":
        (out / "staging" / "1" / "report.json").unlink()
    (out / "staging" / "2").mkdir(exist_ok=True)
    (out / "staging" / "2" / ".lock").touch()
    assert predict(place, out).code == 1
    assert_same(out, place / "whole")


@needs_posix_signals
@pytest.mark.slow
@pytest.mark.parametrize(
    ("who", "code", "says"),
    [("worker", 2, "a worker process died"), ("command", -signal.SIGKILL, "")],
)
def test_a_kill_among_workers_ends_with_the_same_tars(
    place: Path, tmp_path: Path, who: str, code: int, says: str
) -> None:
    """A worker, or the command, is killed in the middle of a photo, with others at work."""
    out = tmp_path / "out"
    # The base obeys this file at the last photo, when other photos are done.
    (place / "photos" / "b.kill").write_text(who)
    command = [sys.executable, "-m", "spackle", *map(str, words(place, out)), "--workers", "2"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    killed = subprocess.run(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert killed.returncode == code
    assert says in killed.stderr

    # The bytes are the same whether several processes go on, or one.
    written = {tar: tar.stat().st_mtime_ns for tar in out.glob("results-*.tar")}
    assert TARS[2] not in {tar.name for tar in written}
    assert predict(place, out, "--workers", 2).code == 1
    assert_same(out, place / "whole")
    # What was done before is not done again.
    assert all(tar.stat().st_mtime_ns == time_ns for tar, time_ns in written.items())
