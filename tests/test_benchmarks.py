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
