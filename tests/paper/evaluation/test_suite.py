"""`benchmarks/suite.py`: its sections, and the naive renderer, which draws the same picture as ours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import suite
from helpers.command import names_in
from naive_renderer import naive_render
from suite_scenes import photo_scene

from spackle.render import CpuRenderer

SIDE = 64
PEAKS = {suite.PRODUCT.format("fp32"): 1e6, suite.PRODUCT.format("bf16"): 4e6, suite.COPY: 2e6}


def test_the_renderers_section_and_the_naive_renderers_picture() -> None:
    timed, facts = suite.renderer_section(2, SIDE, PEAKS)
    found = {row.name: row for row in timed}
    whole, naive = found["whole call: RGB, depth, alpha"], found["naive: whole call"]
    assert found["naive over ours"].values == pytest.approx(naive.values / whole.values)
    scene, camera = photo_scene(SIDE)
    difference = (CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs()
    assert float(difference.mean()) < 1e-5
    assert float(difference.amax()) < 0.02
    assert facts["gaussians"] == (count := len(scene)) == SIDE * SIDE // 2
    assert whole.limit_ms == pytest.approx((count * 56 + SIDE * SIDE * 20) / 2e6)


def test_sections_are_gathered_and_missing_weights_are_named(tmp_path: Path) -> None:
    words = ["-o", str(tmp_path / "out"), "--side", str(SIDE), "--runs", "1"]
    suite.main([*words, "--only", "renderer,completion,sharp"])
    assert names_in(tmp_path / "out") == {"suite.json", "suite.md"}
    found = json.loads((tmp_path / "out" / "suite.json").read_text())["sections"]
    assert set(found) == {"limits", "renderer", "completion", "sharp"}
    completion = found["completion"]["facts"]
    assert (completion["holes"], completion["added"] > 0) == (pytest.approx(0.05, rel=0.05), True)
    assert "no weights" in found["sharp"]["facts"]["not run"]
    with pytest.raises(SystemExit):
        suite.main([*words, "--only", "rendrer"])
