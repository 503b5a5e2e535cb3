"""The benchmarks of speed run at a small size, and their naive renderer draws what ours draws."""

from __future__ import annotations

import json
from pathlib import Path

import suite
import torch
from naive_renderer import naive_render
from suite_scenes import holed_scene, photo_scene

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
