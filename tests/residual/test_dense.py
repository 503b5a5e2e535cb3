"""What a GPU computes of a view's holes, held to the processor's kernels; on a device that mixes with no other."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from far_device import FarDevice, Watched, far_device
from holes import box_view, random_network, random_view
from scenes import away, shifted
from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.inpaint.exemplar import exemplar, nearest_known
from spackle.inpaint.exemplar_dense import dense_exemplar, dense_nearest_known
from spackle.render import CpuRenderer, GsplatRenderer, cuda
from spackle.render.protocol import Rendering
from spackle.residual import Cues, make_seeds
from spackle.residual.occlusion_guard import OcclusionGuard, push_behind
from spackle.residual.seeds import Rim
from spackle.surface import dense_slope, surface_slope

__all__ = ["far_device"]  # a fixture


def to_far(value: Any) -> Any:
    """Tensors and the dataclasses that hold them, moved; cameras stay."""
    if isinstance(value, Tensor):
        return value.to("meta")
    if dataclasses.is_dataclass(value) and not isinstance(value, (Camera, type)):
        return dataclasses.replace(value, **{name: to_far(part) for name, part in vars(value).items()})
    return value


def agree(found: Any, expected: Any, **tolerance: float) -> None:
    """Every tensor of a dataclass, but for single cells at the edge between two answers."""
    for field in dataclasses.fields(expected):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(other, Tensor):
            one = one.to("cpu")
            assert one.dtype == other.dtype, field.name
            assert one.shape == other.shape, field.name
            same = torch.isclose(one.double(), other.double(), **{"rtol": 1e-4, "atol": 1e-5, **tolerance})
            assert float(same.double().mean()) > 0.99, field.name


def views(seed: int, height: int, width: int) -> tuple[Rendering, Camera, Camera]:
    generator = torch.Generator().manual_seed(seed)
    photo = Camera.from_focal(25, width, height)
    eye = torch.rand(3, generator=generator) - 0.5
    view = random_view(seed, height, width)
    solid = torch.rand(height, width, generator=generator) < 0.8
    solid[: height // 3] |= view.alpha[: height // 3] >= 0
    view = Rendering(view.rgb, torch.where(solid, 2 + view.depth, view.depth), torch.where(solid, 1.0, view.alpha))
    return view, photo.looking(eye, torch.tensor([0.1, 0.2, 3.0])), photo


@pytest.mark.parametrize(("seed", "height", "width"), [(0, 40, 52), (1, 33, 47), (2, 7, 90), (3, 64, 5)])
def test_cues_seeds_guards_and_rims_are_the_processors(
    seed: int, height: int, width: int, far_device: FarDevice
) -> None:
    view, camera, photo = views(seed, height, width)
    cues = Cues.of(view)
    agree(Cues.of(to_far(view)), cues)
    seeds = make_seeds(cues, camera, photo)
    agree(make_seeds(to_far(cues), camera, photo), seeds, rtol=2e-3, atol=1e-3)
    agree(OcclusionGuard.of(to_far(view), camera), OcclusionGuard.of(view, camera), rtol=0, atol=0)
    rim = Rim.of(cues, seeds, camera, photo)
    found = Rim.of(to_far(cues), to_far(seeds), camera, photo)
    agree(found, rim)


def test_a_view_that_shows_nothing_makes_a_grey_wall_there_too(far_device: FarDevice) -> None:
    camera = Camera.from_focal(20, 6, 4)
    nothing = Rendering(torch.zeros(4, 6, 3), torch.zeros(4, 6), torch.zeros(4, 6))
    agree(make_seeds(to_far(Cues.of(nothing)), camera, camera), make_seeds(Cues.of(nothing), camera, camera))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (13, 8)])
def test_slopes_are_the_processors(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    for roughness in (0.001, 0.02, 0.5):
        image = 1 + roughness * torch.rand(size, generator=generator, dtype=torch.float64)
        torch.testing.assert_close(dense_slope(image), surface_slope(image), rtol=1e-12, atol=0)


def test_what_is_pushed_goes_as_far(far_device: FarDevice) -> None:
    generator = torch.Generator().manual_seed(5)
    aux = Gaussians(
        6 * torch.randn(300, 3, generator=generator),
        torch.randn(300, 4, generator=generator),
        torch.rand(300, 3, generator=generator),
        torch.rand(300, generator=generator),
        torch.rand(300, 3, generator=generator),
    )
    camera = Camera.from_focal(20, 16, 12)
    depths = [8 * torch.rand(12, 16, generator=generator) for _ in range(3)]
    guards = [
        OcclusionGuard(c, d * (d > 3))
        for c, d in zip([camera, shifted(camera, 1.5), away(camera)], depths, strict=True)
    ]
    eye = torch.randn(3, generator=generator)
    expected, found = push_behind(aux, eye, guards), push_behind(to_far(aux), eye, [to_far(g) for g in guards])
    assert len(found) == len(expected)
    agree(found, expected)


def test_a_view_and_a_path_are_completed_where_the_renderer_is(
    far_device: FarDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    completer, camera = box_view(width=48, height=36)
    completer = dataclasses.replace(completer, network=random_network())
    expected = completer.complete_view(camera)
    path = [camera, shifted(camera, 0.1)]
    along = completer.complete_scene(path, exact=True)
    monkeypatch.setattr(cuda, "load_gsplat", lambda device: Watched(far_device))
    there = dataclasses.replace(completer, renderer=GsplatRenderer("meta"))
    found, view = there.completed_view(camera)
    assert found.means.device == view.rgb.device == torch.device("cpu")
    assert abs(len(found) - len(expected)) <= 0.02 * len(expected)
    drawn, best = (CpuRenderer().render([completer.base, aux], camera) for aux in (found, expected))
    assert float((drawn.rgb - best.rgb).abs().mean()) < 0.005
    # Two blobs of opacity 0.99 leave the light at which renderers stop: rounding says whether the second counts.
    assert float((view.rgb - drawn.rgb).abs().mean()) < 1e-3
    assert float(drawn.alpha.min()) > 0.5
    far_device.waits.clear()
    there.there.completed_view(camera, [there.photo_guard()])
    assert far_device.waits.count("aten._to_copy.default") == 1  # the mask, which the network is cut out by; no picture
    assert abs(len(there.complete_scene(path, exact=True)) - len(along)) <= 0.05 * len(along)


@pytest.mark.parametrize(("height", "width"), [(120, 110), (40, 61)])
def test_patches_are_those_that_the_processor_finds(height: int, width: int) -> None:
    rgb = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    hole = torch.zeros(height, width, dtype=torch.bool)
    hole[height // 3 : height // 2, width // 3 : width // 2] = hole[-height // 5 :, -3:] = True
    inverse = (torch.linspace(-1.5, 0, width) + 0.1 * rgb[..., 0]).exp()
    near, far = torch.from_numpy(nearest_known(hole.numpy())), dense_nearest_known(hole)
    own = torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"))
    assert bool(((far - own).square().sum(0) <= (near - own).square().sum(0)).all())
    expected, found = exemplar(rgb, hole, inverse), dense_exemplar(rgb, hole, inverse)
    assert torch.equal(found.rgb[~hole], rgb[~hole])
    assert torch.equal(found.mismatch > 0, hole)
    assert float((found.matches == expected.matches).all(-1)[hole].float().mean()) > 0.8
    assert float(found.mismatch[hole].mean()) == pytest.approx(float(expected.mismatch[hole].mean()), rel=0.01)
    for bad in (torch.zeros_like(hole), torch.ones_like(hole)):
        assert torch.equal(dense_exemplar(rgb, bad, inverse).rgb, exemplar(rgb, bad, inverse).rgb)
