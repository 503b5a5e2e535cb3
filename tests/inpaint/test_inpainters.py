"""Inpainters that need no weights: they touch the holes alone, and geometry is calm from view to view."""

from __future__ import annotations

import dataclasses
import runpy
from pathlib import Path

import pytest
import torch
from scenes import box_before_wall, shifted

from spackle.bases.lift import lift
from spackle.camera_path import DepthRange
from spackle.dataset.views import PathChoice, path_cameras, render_views, scene_completion
from spackle.errors import InputError
from spackle.inpaint import Inpainter, InpainterOptions, get_inpainter
from spackle.render import get_renderer


def inpainter(name: str) -> Inpainter:
    return get_inpainter(name, InpainterOptions(complete_scene=scene_completion(get_renderer())))


@pytest.mark.parametrize("name", ["geometry", "opencv", "none"])
def test_inpainters_touch_the_holes_alone(name: str) -> None:
    if name == "opencv":
        pytest.importorskip("cv2")
    scene = box_before_wall()
    base = lift(scene.rgb, scene.depth_map, scene.camera).gaussians
    views = [scene.camera, shifted(scene.camera, 0.4), shifted(scene.camera, -0.3)]
    stack = render_views(base, scene.camera, views, get_renderer())
    targets = inpainter(name).complete(stack)
    assert targets.shape == stack.rgb.shape
    assert torch.equal(targets[~stack.mask], stack.rgb[~stack.mask])
    assert bool((targets[stack.mask].amax(-1) > 0.2).all()) == (name != "none")
    seen = dataclasses.replace(stack, mask=torch.zeros_like(stack.mask))
    assert torch.equal(inpainter(name).complete(seen), stack.rgb)


def test_geometry_is_calmer_than_views_completed_one_by_one() -> None:
    bench = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "flicker.py"))
    rgb, depth, camera = bench["scene"](128)
    base = lift(rgb, depth, camera).gaussians
    cameras = path_cameras(PathChoice("swipe", 0.4), camera, DepthRange.of(base), 8)
    stack = render_views(base, camera, cameras, get_renderer())
    order = list(range(1, len(cameras)))
    calm, off = bench["flicker"](stack, inpainter("geometry").complete(stack), order)
    restless, other_off = bench["flicker"](stack, bench["by_view"](stack), order)
    assert calm < restless / 3
    assert off < 1.1 * other_off


def test_an_unknown_name_and_geometry_without_a_scene_are_refused() -> None:
    with pytest.raises(InputError, match="there are geometry, opencv, propainter, none"):
        inpainter("lama")
    with pytest.raises(ValueError, match="complete_scene"):
        get_inpainter("geometry", InpainterOptions())
