"""The rules of CONTRIBUTING.md: completion fills holes only, and keeps the base and the photo."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
from pathlib import Path

import pytest
import torch
from helpers.holes import CPU, random_network
from helpers.scenes import away, box_before_wall, psnr, same_bits, slanted_plane
from hypothesis import given, settings
from hypothesis import strategies as st

import spackle
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import TRAJECTORIES, DepthRange, trajectory_cameras
from spackle.residual import CELL, ViewFeatures, hole_area_ratio, hole_mask
from spackle.residual.features import cell_centers
from spackle.scene_fill import FillContext, fill_scene, fill_view
from spackle.scene_fill.fill import PASSES

SOURCES = Path(spackle.__file__).parent
SCENES = {
    "box": box_before_wall(),
    "odd": box_before_wall(width=63, height=47, focal=50),
    "floor": slanted_plane(1.5, 6, 0, width=96, height=72, focal=90),
    "side wall": slanted_plane(1.5, 6, 1, width=96, height=72, focal=90),
}

EACH = pytest.mark.parametrize(
    ("name", "network"), [*((name, False) for name in SCENES), ("odd", True)]
)


@functools.cache
def context_of(name: str, network: bool = False) -> FillContext:
    scene = SCENES[name]
    return FillContext(scene.base(), scene.camera, CPU, random_network() if network else None)


def path_of(
    subject: FillContext, kind: str, disparity: float = 0.3, frames: int = 4
) -> list[Camera]:
    return trajectory_cameras(
        kind, subject.photo_camera, disparity, DepthRange.of(subject.base, is_metric=True), frames
    )  # type: ignore[arg-type]


@EACH
def test_rule_1_the_base_comes_first_and_unchanged(name: str, network: bool) -> None:
    subject = context_of(name, network)
    kept = Gaussians(*(t.clone() for t in subject.base.tensors))
    path = path_of(subject, "swipe")
    view = fill_view(subject, path[-1], [subject.photo_guard()]).aux
    for aux in (view, fill_scene(subject, path).aux):
        assert len(aux) > 0
        assert same_bits(subject.base, kept)
        merged = Gaussians.cat([subject.base, aux])
        assert same_bits(merged.select(slice(0, len(kept))), kept)
        assert same_bits(merged.select(slice(len(kept), None)), aux)


@settings(deadline=None, max_examples=10)
@given(st.sampled_from(sorted(SCENES)), st.floats(-0.6, 0.6), st.floats(-0.3, 0.3), st.booleans())
def test_rule_2_each_aux_gaussian_comes_from_a_masked_cell(
    name: str, right: float, down: float, guarded: bool
) -> None:
    subject = context_of(name)
    camera = subject.photo_camera.looking(
        torch.tensor([right, down, 0.0]), torch.tensor([0.0, 0.0, 4.0])
    )
    mask = ViewFeatures.of(CPU.render(subject.base, camera)).mask
    aux = fill_view(subject, camera, [subject.photo_guard()] if guarded else []).aux
    uv, z = camera.project(aux.means)
    column, row = (uv / 2).floor().long().unbind(-1)
    beside = (
        uv - cell_centers(camera)[row, column]
    ).abs()  # 0 at a cell's centre, 0.5 at a pixel's centre
    torch.testing.assert_close(
        torch.where(beside > 0.25, beside - 0.5, beside), 0 * beside, rtol=0, atol=0.02
    )
    most = CELL**2 + PASSES
    assert bool((z > 0).all())
    assert bool(mask[row, column].all())
    assert int(torch.bincount(row * mask.shape[1] + column, minlength=1).max()) <= most
    assert len(aux) >= int(mask.sum()) if not guarded else len(aux) <= most * int(mask.sum())
    wild = dataclasses.replace(subject, network=random_network(size=0.05))
    assert int(mask.sum()) <= len(fill_view(wild, camera).aux) <= most * int(mask.sum())


@EACH
def test_rule_3_a_view_without_holes_renders_as_the_base(name: str, network: bool) -> None:
    subject = context_of(name, network)
    photo = CPU.render(subject.base, subject.photo_camera)
    assert not hole_mask(photo.alpha).any()
    aux = fill_view(subject, subject.photo_camera).aux
    assert len(aux) == 0
    assert len(fill_scene(subject, [subject.photo_camera] * 2).aux) == 0
    hidden = fill_view(subject, away(subject.photo_camera)).aux
    assert len(hidden) > 0  # behind the photo's camera
    for more in (aux, hidden):
        assert same_bits(CPU.render([subject.base, more], subject.photo_camera), photo)
        assert same_bits(
            CPU.render(Gaussians.cat([subject.base, more]), subject.photo_camera), photo
        )


@pytest.mark.parametrize(
    ("name", "network", "kind", "disparity"),
    [*itertools.product(SCENES, [False], TRAJECTORIES, [0.3, 0.6]), ("box", True, "swipe", 0.3)],
)
def test_rule_4_a_completed_scene_keeps_the_photo(
    name: str, network: bool, kind: str, disparity: float
) -> None:
    subject = context_of(name, network)
    aux = fill_scene(subject, path_of(subject, kind, disparity, frames=8)).aux
    before = CPU.render(subject.base, subject.photo_camera)
    after = CPU.render([subject.base, aux], subject.photo_camera)
    assert len(aux) > 0
    assert psnr(after.rgb, before.rgb) >= 45
    assert hole_area_ratio(after.alpha) == 0


def test_rule_5_every_file_with_compiled_kernels_has_a_test() -> None:
    compiled = re.compile(
        r"^\s*@(\w+\.)?(\w*kernel|n?jit|\w*vectorize)\b|\b(n?jit)\(", re.MULTILINE
    )
    tests = "\n".join(
        path.read_text(encoding="utf-8") for path in Path(__file__).parent.rglob("*.py")
    )
    for path in SOURCES.rglob("*.py"):
        module = ".".join(path.relative_to(SOURCES).with_suffix("").parts)
        if not compiled.search(path.read_text(encoding="utf-8")) or module.startswith("render."):
            continue
        package, _, name = module.rpartition(".")
        names_from_module = f"from spackle.{module} import"
        module_from_package = rf"from spackle\.{package} import [^\n]*\b{name}\b"
        assert names_from_module in tests or re.search(module_from_package, tests), (
            f"{module}: where is the test of its kernels?"
        )
