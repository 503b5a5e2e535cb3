"""The GPU renderer: its own arithmetic over a stand-in for gsplat, and over gsplat itself where there is a GPU."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from types import ModuleType
from typing import Any

import gsplat_stand_in
import pytest
import torch
from scenes import box_before_wall, same_bits, shifted
from torch import Tensor

from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer, get_renderer
from spackle.render.cuda import GsplatRenderer, SetStore, load_gsplat
from spackle.render.protocol import Rendering

CPU = CpuRenderer()
SCENE = box_before_wall(width=45, height=35, focal=40)
BASE = SCENE.base()
SIDE = shifted(SCENE.camera, 0.4)
REAL = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


@pytest.fixture(params=["stand-in", pytest.param("gsplat", marks=pytest.mark.skipif(not REAL, reason="no GPU"))])
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> GsplatRenderer:
    if request.param == "gsplat":
        return GsplatRenderer()
    monkeypatch.setattr("spackle.render.cuda.load_gsplat", lambda device: gsplat_stand_in)
    return GsplatRenderer("cpu")


def agree(one: Rendering, other: Rendering) -> None:
    """Equal but at the thresholds, where a difference of the last digit means one splat more or less."""
    same = ((one.rgb - other.rgb).abs().amax(-1) < 2e-4) & ((one.alpha - other.alpha).abs() < 1e-4)
    assert float(same.float().mean()) > 0.97
    torch.testing.assert_close(one.rgb, other.rgb, atol=2e-2, rtol=0)
    torch.testing.assert_close(one.depth[same], other.depth[same], rtol=2e-3, atol=0)


def test_it_draws_what_the_processors_renderer_draws(gpu: GsplatRenderer) -> None:
    for camera in (SCENE.camera, SIDE):
        for eps2d in (0.0, 0.3):
            found = gpu.render(BASE, camera, eps2d=eps2d)
            assert found.rgb.dtype == torch.float32
            assert found.rgb.device == BASE.means.device
            agree(found, CPU.render(BASE, camera, eps2d=eps2d))


def test_sets_are_drawn_as_one_none_is_black_and_what_is_not_finite_is_left_out(gpu: GsplatRenderer) -> None:
    whole = gpu.render(BASE, SIDE)
    assert same_bits(gpu.render([BASE.select(slice(0, 100)), BASE.select(slice(100, None))], SIDE), whole)
    nothing = gpu.render([], SIDE)
    assert nothing.rgb.shape == (35, 45, 3)
    assert not any(bool(image.any()) for image in nothing.tensors)
    broken = dataclasses.replace(BASE, means=BASE.means.clone())
    broken.means[7, 1] = torch.nan
    assert same_bits(gpu.render(broken, SIDE), gpu.render(BASE.select(torch.arange(len(BASE)) != 7), SIDE))


def test_gradients_are_those_of_the_processors_renderer(gpu: GsplatRenderer) -> None:
    weights = torch.rand(35, 45, generator=torch.Generator().manual_seed(0))
    found = []
    for renderer in (gpu, CPU):
        asking = Gaussians(*(t.clone().requires_grad_() for t in BASE.tensors))
        view = renderer.render(asking, SIDE)
        ((view.rgb.mean(-1) + 0.1 * view.depth + view.alpha) * weights).sum().backward()
        found.append([t.grad for t in asking.tensors])
    for one, other in zip(*found, strict=True):
        assert one is not None
        assert other is not None
        assert float((one - other).norm() / other.norm()) < 0.02


def test_wanted_tiles_are_drawn_and_the_others_stay_bit_for_bit(gpu: GsplatRenderer) -> None:
    whole, under = gpu.render(BASE, SIDE), CPU.render(BASE, SCENE.camera)
    tiles = torch.zeros(3, 3, dtype=torch.bool)
    tiles[1, 2] = tiles[0, 0] = True
    mask = tiles.repeat_interleave(16, 0).repeat_interleave(16, 1)[:35, :45]
    black = Rendering(*(torch.zeros_like(image) for image in whole.tensors))
    for onto in (under, None):
        found = gpu.render(BASE, SIDE, tiles=tiles, onto=onto)
        for image, drawn, kept in zip(found.tensors, whole.tensors, (onto or black).tensors, strict=True):
            assert torch.equal(image[~mask], kept[~mask])
            torch.testing.assert_close(image[mask], drawn[mask], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="expected"):
        gpu.render(BASE, SIDE, tiles=tiles[:2])


def test_a_scene_travels_once() -> None:
    store = SetStore(torch.device("cpu"))
    kept = Gaussians(*(tensor.clone() for tensor in BASE.tensors))
    first = store.material(kept)
    assert store.material(kept) is first
    assert store.material(dataclasses.replace(kept, colors=kept.colors.clone())) is not first
    again = store.material(kept)
    kept.colors.mul_(0.5)
    assert store.material(kept) is not again
    torch.testing.assert_close(store.material(kept).colors, kept.colors)
    asking = Gaussians(*(tensor.clone().requires_grad_() for tensor in BASE.tensors))
    assert store.material(asking) is not store.material(asking)  # it changes at every step of a training
    with torch.inference_mode():
        passing = Gaussians(*(tensor.clone() for tensor in BASE.tensors))
        assert store.material(passing) is not store.material(passing)
    assert len(store._entries) == 1
    del kept
    assert len(store._entries) == 0


def test_a_scene_is_projected_once_for_a_camera(gpu: GsplatRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    package = gpu._gsplat

    class Counting:
        def __getattr__(self, name: str) -> Any:
            return getattr(package, name)

        def fully_fused_projection(self, means: Tensor, *arguments: Any, **options: Any) -> Any:
            counts.append(len(means))
            return package.fully_fused_projection(means, *arguments, **options)

    monkeypatch.setattr(gpu, "_gsplat", Counting())
    more = BASE.select(slice(0, 50))
    tiles = torch.ones(3, 3, dtype=torch.bool)
    whole = gpu.render(BASE, SIDE)
    redrawn = gpu.render([BASE, more], SIDE, tiles=tiles, onto=whole)
    gpu.render([BASE, more], SIDE)
    assert counts == [len(BASE), 50]
    assert same_bits(redrawn, gpu.render([BASE, more], SIDE))
    gpu.render(BASE, SCENE.camera)
    gpu.render(BASE, SIDE, eps2d=0.3)
    assert counts == [len(BASE), 50, len(BASE), len(BASE)]


def test_a_machine_without_a_gpu_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="--device cuda: PyTorch sees no NVIDIA GPU"):
        get_renderer("cuda")
    assert isinstance(get_renderer("auto"), CpuRenderer)


class BrokenBuild:
    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name == "gsplat":
            raise RuntimeError("Error building extension 'gsplat_cuda': ninja\nmany lines")


def test_a_gsplat_that_cannot_be_used_is_told_in_a_line_and_auto_falls_back(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    def refused(says: str) -> None:
        with pytest.raises(InputError, match=says) as caught:
            get_renderer("cuda")
        assert "\n" not in str(caught.value)
        caplog.clear()
        assert isinstance(get_renderer("auto"), CpuRenderer)
        assert str(caught.value) in caplog.text

    monkeypatch.setitem(sys.modules, "gsplat", None)
    refused(r"spackle-nvs\[cuda\]")
    gsplat, cuda, backend = (ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"))
    backend._C, gsplat.cuda, cuda._backend = None, cuda, backend  # type: ignore[attr-defined]
    for module in (gsplat, cuda, backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    refused("no kernels here")
    backend._C = object()  # type: ignore[attr-defined]
    assert load_gsplat(torch.device("cuda")).__name__ == "gsplat"
    assert isinstance(get_renderer("auto"), GsplatRenderer)
    monkeypatch.delitem(sys.modules, "gsplat")
    monkeypatch.setattr(sys, "meta_path", [BrokenBuild(), *sys.meta_path])
    refused("cannot be built here: Error building")
