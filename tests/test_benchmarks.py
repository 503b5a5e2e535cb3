"""The benchmarks of speed run at a small size, and their naive renderer draws what ours draws."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import posed_photos
import posed_scenes
import pytest
import suite
import torch
from many_photos import ProcessFacts, Sample, family_of, table_row
from naive_renderer import naive_render
from suite_scenes import holed_scene, photo_scene

from spackle.posed.capture import read_capture
from spackle.render import CpuRenderer


def test_the_naive_renderer_draws_what_ours_draws() -> None:
    for scene, camera in (photo_scene(48), holed_scene(48)):
        naive = naive_render(scene, camera)
        ours = CpuRenderer().render(scene, camera).rgb
        torch.testing.assert_close(naive, ours, rtol=0, atol=2e-3)


def test_the_suite_measures_the_renderer_and_a_completion(tmp_path: Path) -> None:
    suite.main(["-o", str(tmp_path), "--only", "renderer,completion", "--side", "64", "--runs=1"])
    sections = json.loads((tmp_path / "suite.json").read_text())["sections"]
    assert set(sections) == {"limits", "renderer", "completion"}
    for section in sections.values():
        assert section["figures"]
        assert "not run" not in section["facts"]
    assert "naive over ours" in (tmp_path / "suite.md").read_text()


def test_the_costs_of_a_run_are_those_of_all_its_processes_behind_the_first_photos() -> None:
    def started_by(parent: int) -> ProcessFacts:
        return ProcessFacts(parent=parent, start="0", seconds=1.0, memory_mb=1.0)

    # 5 is the command, 7 and 8 its workers' processes, 9 a stranger's.
    facts = {5: started_by(1), 8: started_by(7), 7: started_by(5), 9: started_by(1)}
    assert family_of(5, facts) == {5, 7, 8}

    samples = [
        Sample(50, 4.0, 2.0, 90.0),
        Sample(100, 9.0, 3.0, 100.0),
        Sample(200, 11.0, 3.5, 101.0),
    ]
    assert table_row("two", samples) == "| two | 200 | 20.0 | 5.0 | 100 | 101 |"


def test_a_rendered_scene_becomes_photos_with_cameras_of_which_some_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posed_scenes, "WIDTH", 64)
    monkeypatch.setattr(posed_scenes, "HEIGHT", 48)
    folder = tmp_path / "still_life"
    monkeypatch.setattr(sys, "argv", ["posed_scenes.py", "still_life", str(folder)])
    posed_scenes.main()

    capture = read_capture(folder)
    assert len(capture.photos) == len(posed_scenes.EYES)
    assert capture.points is not None
    seen = [capture.points.seen_by(photo.camera, photo.name) for photo in capture.photos]
    assert min(len(points.z) for points in seen) > 100

    # The eyes far to the left and right are those farthest from the middle.
    assert sorted(posed_photos.choose(capture, "spread", 3))[1:] == [6, 7]
    near = posed_photos.choose(capture, "near", 3)
    assert set(near) <= {0, 3, 4, 5}
    assert len(set(posed_photos.choose(capture, "random-1", 3))) == 3
