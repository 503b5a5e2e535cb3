"""The GPU renderer, with a stand-in for gsplat, and on a GPU with gsplat."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from helpers import gsplat_stand_in
from helpers.scenes import box_before_wall, random_harmonics, same_bits, shifted

from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer, get_renderer
from spackle.render import gsplat_backend as cuda
from spackle.render.gsplat_backend import (
    GsplatRenderer,
    UploadCache,
    load_gsplat,
    upper_covariances,
)
from spackle.render.protocol import ALPHA_MAX, Rendering
from spackle.runtime.errors import InputError, NotEnoughMemory

CPU = CpuRenderer()
SCENE = box_before_wall(width=45, height=35, focal=40)
BASE = SCENE.base()
SIDE = shifted(SCENE.camera, 0.4)
TILES = torch.tensor([[True, False, False], [False, False, True], [False, False, False]])


@pytest.fixture(params=["stand-in", "gsplat"])
def gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> GsplatRenderer:
    if request.param == "gsplat":
        try:
            return GsplatRenderer()
        except InputError as error:
            pytest.skip(str(error))
    monkeypatch.setattr(cuda, "load_gsplat", lambda device: gsplat_stand_in)
    return GsplatRenderer("cpu")


def agree(one: Rendering, other: Rendering) -> None:
    """Equal except for pixels at a threshold.

    There, the last digit decides whether a Gaussian is drawn.
    """
    same = ((one.rgb - other.rgb).abs().amax(-1) < 2e-4) & ((one.alpha - other.alpha).abs() < 1e-4)
    assert float(same.float().mean()) > 0.97
    torch.testing.assert_close(one.rgb, other.rgb, atol=2e-2, rtol=0)
    torch.testing.assert_close(one.depth[same], other.depth[same], rtol=2e-3, atol=0)


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_a_scene_in_another_unit_gives_the_same_picture(gpu: GsplatRenderer, size: float) -> None:
    scaled = dataclasses.replace(BASE, means=BASE.means * size, scales=BASE.scales * size)
    expected = gpu.render(BASE, SCENE.camera)
    view = gpu.render(scaled, SCENE.camera)
    agree(view, dataclasses.replace(expected, depth=expected.depth * size))
    assert bool(view.alpha.mean() > 0.9)


def test_images_match_the_cpu_renderer(gpu: GsplatRenderer) -> None:
    for camera in (SCENE.camera, SIDE):
        for eps2d in (0.0, 0.3):
            found = gpu.render(BASE, camera, eps2d=eps2d)
            assert (found.rgb.dtype, found.rgb.device) == (torch.float32, BASE.means.device)
            agree(found, CPU.render(BASE, camera, eps2d=eps2d))
    ones = torch.ones(1, 3)
    opaque = Gaussians(torch.tensor([[0.0, 0.0, 2.0]]), torch.eye(4)[:1], ones, torch.ones(1), ones)
    assert float(gpu.render(opaque, SCENE.camera).alpha.max()) == pytest.approx(ALPHA_MAX, abs=1e-5)


def test_sets_are_drawn_together_without_bad_gaussians(gpu: GsplatRenderer) -> None:
    whole, empty = gpu.render(BASE, SIDE), Gaussians.empty()
    assert same_bits(
        gpu.render([BASE.select(slice(0, 100)), empty, BASE.select(slice(100, None))], SIDE), whole
    )
    broken = dataclasses.replace(BASE, means=BASE.means.clone())
    broken.means[7, 1] = torch.nan
    assert same_bits(
        gpu.render(broken, SIDE), gpu.render(BASE.select(torch.arange(len(BASE)) != 7), SIDE)
    )


def test_empty_sets_are_not_passed_to_gsplat(gpu: GsplatRenderer) -> None:
    empty = Gaussians.empty()
    for tiles in (None, TILES):
        for sets in ([], empty, [empty, empty]):
            view = gpu.render(sets, SIDE, tiles=tiles)
            assert view.rgb.shape == (35, 45, 3)
            assert not any(bool(image.any()) for image in view.tensors)


def test_gradients_match_the_cpu_renderer(gpu: GsplatRenderer) -> None:
    small = box_before_wall(width=24, height=20, focal=22)
    weights = torch.rand(20, 24, generator=torch.Generator().manual_seed(0))
    found = []
    for renderer in (gpu, CPU):
        asking = Gaussians(*(t.clone().requires_grad_() for t in small.base().tensors))
        view = renderer.render(asking, shifted(small.camera, 0.4))
        loss = ((view.rgb.mean(-1) + 0.1 * view.depth + view.alpha) * weights).sum()
        found.append(torch.autograd.grad(loss, asking.tensors))
    for one, other in zip(*found, strict=True):
        assert float((one - other).norm() / other.norm()) < 0.02


def test_harmonics_match_the_cpu_renderer(gpu: GsplatRenderer) -> None:
    small = box_before_wall(width=24, height=20, focal=22)
    base = small.base()
    base = dataclasses.replace(base, harmonics=0.5 * random_harmonics(len(base), 3))
    cameras = [small.camera, shifted(small.camera, 0.4)]
    for camera, view in zip(cameras, gpu.render_batch([[base], [base]], cameras), strict=True):
        agree(view, CPU.render(base, camera))
        plain = CPU.render(base.with_harmonics_count(0), camera)
        assert float((view.rgb - plain.rgb).abs().mean()) > 0.02
    weights = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(0))
    gradients = []
    for renderer in (gpu, CPU):
        leaf = Gaussians(*(t.clone().requires_grad_() for t in base.tensors))
        loss = (renderer.render(leaf, cameras[1]).rgb * weights).sum()
        gradients.append(torch.autograd.grad(loss, leaf.tensors))
    for one, other in zip(*gradients, strict=True):
        assert float((one - other).norm() / other.norm()) < 0.02
    assert base.harmonics is not None
    base.harmonics[7, 2, 1] = torch.nan
    left = base.select(torch.arange(len(base)) != 7)
    assert same_bits(gpu.render(base, cameras[1]), gpu.render(left, cameras[1]))


def test_only_wanted_tiles_change(gpu: GsplatRenderer) -> None:
    whole, under = gpu.render(BASE, SIDE), CPU.render(BASE, SCENE.camera)
    mask = TILES.repeat_interleave(16, 0).repeat_interleave(16, 1)[:35, :45]
    black = Rendering(*(torch.zeros_like(image) for image in whole.tensors))
    for onto in (under, None):
        found = gpu.render(BASE, SIDE, tiles=TILES, previous_rendering=onto)
        for image, drawn, kept in zip(
            found.tensors, whole.tensors, (onto or black).tensors, strict=True
        ):
            assert torch.equal(image[~mask], kept[~mask])
            torch.testing.assert_close(image[mask], drawn[mask], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="expected"):
        gpu.render(BASE, SIDE, tiles=TILES[:2])


def test_a_batch_of_views_equals_single_views_bit_for_bit(gpu: GsplatRenderer) -> None:
    scenes = [
        [BASE, BASE.select(slice(0, 50))],
        [],
        [Gaussians.empty(), BASE.select(slice(40, None))],
    ]
    cameras, tiles = [SIDE, SIDE, SCENE.camera], [None, TILES, TILES]
    onto = [None, None, CPU.render(BASE, SCENE.camera)]
    together = gpu.render_batch(scenes, cameras, tiles=tiles, previous_renderings=onto)
    views = list(zip(scenes, cameras, tiles, onto, strict=True))
    alone = [
        gpu.render(sets, camera, tiles=tile, previous_rendering=under)
        for sets, camera, tile, under in views
    ]
    assert all(map(same_bits, together, alone))
    for one, (sets, camera, tile, under) in zip(together, views, strict=True):
        agree(one, CPU.render(sets, camera, tiles=tile, previous_rendering=under))
    with pytest.raises(ValueError, match="one size"):
        gpu.render_batch([[BASE]] * 2, [SIDE, SIDE.resized(40, 40)])


def test_covariances_are_float32_under_autocast() -> None:
    expected = BASE.to(dtype=torch.float64).covariances()[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    with torch.autocast("cpu", torch.bfloat16):
        found = upper_covariances(BASE)
    assert found.dtype == torch.float32
    torch.testing.assert_close(
        found.double(), expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max())
    )


def test_a_shortage_of_memory_is_reported(
    gpu: GsplatRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda, "MAX_LIST_ENTRIES", 10)
    with pytest.raises(NotEnoughMemory, match=f"{len(BASE):,} Gaussians at 45×35"):
        gpu.render(BASE, SIDE)


def test_the_stand_in_has_gsplats_own_signatures() -> None:
    package = pytest.importorskip("gsplat")
    for name in (
        "fully_fused_projection",
        "isect_tiles",
        "isect_offset_encode",
        "rasterize_to_pixels",
    ):
        ours, theirs = (
            inspect.signature(getattr(of, name)).parameters for of in (gsplat_stand_in, package)
        )
        assert all(theirs[key].default == ours[key].default for key in ours), name
        positional = [
            key for key in ours if ours[key].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
        ]
        assert positional == list(theirs)[: len(positional)], name


def test_an_unchanged_scene_is_uploaded_once() -> None:
    store = UploadCache(torch.device("cpu"))
    upload = store.upload
    kept = Gaussians(*(tensor.clone() for tensor in BASE.tensors))
    first = upload(kept)
    assert upload(kept) is first
    assert upload(dataclasses.replace(kept, colors=kept.colors.clone())) is not first
    again = upload(kept)
    kept.colors.mul_(0.5)
    assert upload(kept) is not again
    torch.testing.assert_close(upload(kept).colors, kept.colors)
    asking = Gaussians(*(tensor.clone().requires_grad_() for tensor in BASE.tensors))
    assert upload(asking) is not upload(asking)
    with torch.inference_mode():
        passing = Gaussians(*(tensor.clone() for tensor in BASE.tensors))
        assert upload(passing) is not upload(passing)
    assert len(store._uploads) == 1
    del kept
    assert len(store._uploads) == 0


def modules(version: str, backend: object) -> dict[str, Any]:
    """Stand-ins for the modules of gsplat."""
    gsplat, inner, built = (
        ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend")
    )
    vars(built)["_C"], vars(inner)["_backend"] = backend, built
    vars(gsplat).update(cuda=inner, __version__=version)
    return {module.__name__: module for module in (gsplat, inner, built)}


UNUSABLE: dict[str, dict[str, Any]] = {
    r"gsplat.*: pip install 'spackle-nvs\[cuda\]'": {"gsplat": None},
    "its version is 1.6.0, not 1.5": modules("1.6.0", object()),
    "it has no kernels": modules("1.5.3", None),
}


@pytest.mark.parametrize("says", UNUSABLE)
def test_an_unusable_gsplat_is_refused_and_auto_falls_back(
    says: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name, module in UNUSABLE[says].items():
        monkeypatch.setitem(sys.modules, name, module)
    with pytest.raises(InputError, match=f"^`device` cuda: .*{says}") as caught:
        get_renderer("cuda")
    assert "\n" not in str(caught.value)
    assert isinstance(get_renderer("auto"), CpuRenderer)
    assert str(caught.value) in caplog.text


def test_auto_uses_an_available_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name, module in modules("1.5.3", object()).items():
        monkeypatch.setitem(sys.modules, name, module)
    assert load_gsplat(torch.device("cuda")).__name__ == "gsplat"
    assert isinstance(get_renderer("auto"), GsplatRenderer)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="`device` cuda: PyTorch sees no NVIDIA GPU"):
        get_renderer("cuda")
    assert isinstance(get_renderer("auto"), CpuRenderer)
