"""`spackle predict` over many photos: names, results.jsonl, and what a rerun does."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from helpers.command import Run, names_in, refuses, report_of, run
from helpers.flat_base import QUICK, write_small_photos
from helpers.photos import metres, write_depth

import spackle.results.many_photos as many_photos
from spackle.formats.scene_files import load_scene
from spackle.results.results_file import RESULTS_NAME


def predict(photos: Path, out: Path, *options: object) -> Run:
    return run("predict", photos, "-o", out, *QUICK, *options)


def results_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / RESULTS_NAME).read_text().splitlines()]


def test_results_are_listed_and_known_without_reading_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = write_small_photos(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "b.png").write_text("no photo")
    out = tmp_path / "out"
    assert predict(photos, out).code == 1
    first, second, third = results_of(out)
    assert [first["name"], second["name"], third["name"]] == ["a", "b", "c"]
    assert (first["status"], second["status"], third["status"]) == ("ok", "failed", "ok")
    assert first["photo"] == str(photos / "a.png")
    assert first["seconds"] > 0
    sizes = {name: (out / "a" / name).stat().st_size for name in names_in(out / "a")}
    assert first["files"] == sizes
    assert "b.png" in second["error"]

    # A rerun reads only the failed photo again; the others are known by size and time.
    read: list[str] = []
    fingerprint = many_photos.file_fingerprint

    def noted(file: Path, kind: str) -> str:
        if kind == "photo":
            read.append(file.name)
        return fingerprint(file, kind)

    monkeypatch.setattr(many_photos, "file_fingerprint", noted)
    again = predict(photos, out)
    assert "2 of 3 photos done already (--overwrite does them again)" in again.lines
    assert set(read) == {"b.png"}
    assert [line | {"seconds": 0} for line in results_of(out)] == [
        line | {"seconds": 0} for line in (first, second, third)
    ]

    # A photo that was only touched is read, but not predicted again; its line is written anew.
    # Nor does it need results.jsonl.
    scene = (out / "a" / "scene.ply").stat()
    os.utime(photos / "a.png")
    predict(photos, out)
    assert set(read) == {"a.png", "b.png"}
    (out / RESULTS_NAME).unlink()
    predict(photos, out)
    assert (out / "a" / "scene.ply").stat().st_mtime_ns == scene.st_mtime_ns
    assert [line["status"] for line in results_of(out)] == ["ok", "failed", "ok"]


def test_one_photo_that_is_named_has_no_list(tmp_path: Path) -> None:
    photos = write_small_photos(tmp_path, "a.png")
    assert predict(photos / "a.png", tmp_path / "out").code == 0
    assert names_in(tmp_path / "out") == {"a"}


def test_a_tree_and_a_list_are_predicted_with_the_depth_and_lens_that_the_list_states(
    tmp_path: Path,
) -> None:
    photos = write_small_photos(tmp_path / "photos", "a/x.png", "a_x.png", "a/x.jpg")
    out = tmp_path / "out"
    assert predict(photos, out, "--recursive").code == 0
    assert [line["name"] for line in results_of(out)] == ["a/x.jpg", "a/x.png", "a_x"]
    assert names_in(out) == {"a", "a_x", RESULTS_NAME}
    assert names_in(out / "a" / "x.png") == {"scene.ply", "report.json"}

    # The third line's depth is that of no photo, which is an error of this photo alone.
    write_depth(photos / "depth.npy", metres(48, 36))
    lines = [
        {"file_name": "a/x.png", "depth_file_name": "depth.npy", "fov": 90},
        {"file_name": "a_x.png"},
        {"file_name": "a/x.jpg", "depth_file_name": "missing.npy"},
    ]
    (photos / "photos.jsonl").write_text("\n".join(map(json.dumps, lines)))
    listed = tmp_path / "listed"
    options = ("--fill", "none", "--no-render", "--threads", 1)
    result = run("predict", photos / "photos.jsonl", "-o", listed, *options)
    assert (result.code, result.lines[-1]) == (1, "1 of 3 photos failed"), result.err
    with_depth = report_of(listed / "a" / "x.png")
    assert with_depth["base"]["name"] == "rgbd"
    assert with_depth["focal_px"] == pytest.approx(24, rel=1e-3)  # half of the width, at 90 degrees
    assert report_of(listed / "a_x")["base"]["name"] == "lite"
    third = results_of(listed)[2]
    assert third["status"] == "failed"
    assert "missing.npy: no such depth map" in third["error"]

    # Another focal length in the list is another result.
    lines[0]["fov"] = 60
    (photos / "photos.jsonl").write_text("\n".join(map(json.dumps, lines)))
    again = run("predict", photos / "photos.jsonl", "-o", listed, *options)
    assert "1 of 3 photos done already (--overwrite does them again)" in again.lines


def test_outputs_name_the_files_of_a_photo(tmp_path: Path) -> None:
    photo = write_small_photos(tmp_path, "a.png") / "a.png"
    flags = ("--base", "helpers.flat_base:Flat", "--threads", 1, "--overwrite")

    def written(outputs: str, *more: object) -> set[str]:
        result = run("predict", photo, "-o", tmp_path, *flags, "--outputs", outputs, *more)
        assert result.code == 0, result.err
        names = set(report_of(tmp_path / "a")["files"])
        for name in names:
            assert (tmp_path / "a" / name).stat().st_size > 0
        return names

    scenes = {"scene.spz", "scene.ply", "scene.html", "base.ply"}
    assert written(f"{','.join(scenes)}, video.gif", "--frames", 2) == {*scenes, "video.gif"}
    assert len(load_scene(tmp_path / "a" / "scene.spz").gaussians) == len(
        load_scene(tmp_path / "a" / "scene.ply").gaussians
    )
    # What shows no filled hole needs no fill.
    assert written("depth.npy,base.spz,report.json") == {"depth.npy", "base.spz"}
    report = report_of(tmp_path / "a")
    assert (report["residual"]["weights"], report["aux"]["gaussians"]) == ("none", 0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["scene.spx"], "--outputs scene.spx is unknown: did you mean scene.spz? There are scene"),
        ([","], "names no file: there are scene.compressed.ply"),
        (["video.mp4,video.gif"], "give one of them"),
        (["scene.ply", "--keep-base"], "leave --keep-base out"),
        (["scene.ply", "--format", "gif"], "no video.gif is among them: leave --format out"),
        (["base.ply", "--fill", "lama"], "none of them shows filled holes: leave --fill out"),
    ],
)
def test_outputs_that_cannot_be_are_refused(tmp_path: Path, options: list[str], said: str) -> None:
    refuses(run("predict", tmp_path / "a.png", "-o", tmp_path / "o", "--outputs", *options), said)
