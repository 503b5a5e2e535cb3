"""The CPU renderer against hand-computed values, and against the reference renderer."""

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, product

import numpy as np
import pytest
import torch
from helpers.scenes import random_harmonics, random_scene, same_bits, turned_camera
from hypothesis import given, settings
from hypothesis import strategies as st

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.render import TILE_PX, CpuRenderer, get_renderer, touched_tiles
from spackle.render.fast_math import decode_srgb, encode_srgb, exp2, natural_log
from spackle.render.project import BLOCK_GAUSSIANS
from spackle.render.protocol import (
    ALPHA_MAX,
    ALPHA_MIN,
    NEAR_PLANE_RATIO,
    TRANSMITTANCE_STOP,
    Rendering,
    near_plane,
)
from spackle.render.reference import ReferenceRenderer, falloff, front_to_back
from spackle.render.tile_lists import tile_blocks
from spackle.runtime.errors import InputError

CPU, TWIN = CpuRenderer(), ReferenceRenderer()
CAMERA = Camera.from_focal(
    100.0, 33, 33
)  # an odd size: the axis meets the centre of pixel (16, 16)
FIELDS = ("rgb", "depth", "alpha")
SEEDS = st.integers(0, 2**31)
BOTH = pytest.mark.parametrize("renderer", [CPU, TWIN])


def ball(x=0.0, y=0.0, z=2.0, sigma=0.04, opacity=0.5, color=(0.2, 0.4, 0.8)) -> Gaussians:
    """A round Gaussian; at z = 2 its sigma of 0.04 covers 2 of CAMERA's pixels."""
    means, quats, scales = (
        torch.tensor([[x, y, z]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), sigma),
    )
    return Gaussians(means, quats, scales, torch.tensor([opacity]), torch.tensor([color]))


def with_grad(gaussians: Gaussians) -> Gaussians:
    return Gaussians(*(t.clone().requires_grad_() for t in gaussians.tensors))


def backward(view: Rendering) -> None:
    (view.rgb.sum() + view.depth.sum() + view.alpha.sum()).backward()


def sturdy_pixels(gaussians: Gaussians, camera: Camera, eps2d: float) -> torch.Tensor:
    """[H, W] bool: pixels in which no Gaussian is close to a threshold."""
    raw = falloff(front_to_back(gaussians.to(dtype=torch.float64), camera), camera, eps2d)

    def near(values: torch.Tensor, threshold: float, width: float) -> torch.Tensor:
        return ((values / threshold - 1).abs() < width).any(dim=0)

    alphas = torch.where(raw < ALPHA_MIN, 0, raw.clamp_max(ALPHA_MAX))
    passed = torch.cumprod(1 - alphas, dim=0)
    return ~(
        near(raw, ALPHA_MIN, 1e-4)
        | near(raw, ALPHA_MAX, 1e-5)
        | near(passed, TRANSMITTANCE_STOP, 1e-3)
    )


def tile_mask(tiles: torch.Tensor, camera: Camera) -> torch.Tensor:
    return tiles.repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)[
        : camera.height, : camera.width
    ]


@BOTH
def test_one_gaussian_matches_its_formula(renderer):
    view = renderer.render(ball(), CAMERA)
    for dx, dy in [(0, 0), (2, 0), (0, -3), (1, 4)]:
        alpha = 0.5 * math.exp(-(dx * dx + dy * dy) / (2 * 2**2))
        assert float(view.alpha[16 + dy, 16 + dx]) == pytest.approx(alpha, abs=1e-6)
        assert float(view.depth[16 + dy, 16 + dx]) == pytest.approx(2.0, rel=1e-4)
        color = linear_to_srgb(alpha * torch.tensor([0.2, 0.4, 0.8]))
        torch.testing.assert_close(view.rgb[16 + dy, 16 + dx], color, atol=1e-5, rtol=0)


@BOTH
@pytest.mark.parametrize("opacity", [0.004, 0.3, 1.0])
def test_faint_contributions_are_skipped(renderer, opacity):
    view = renderer.render(ball(opacity=opacity), CAMERA)
    squared = (CAMERA.pixel_centers() - 16.5).square().sum(dim=-1)
    drawn = opacity * torch.exp(-squared / 8) >= ALPHA_MIN
    assert torch.equal(view.alpha > 0, drawn)
    assert torch.equal(view.depth > 0, drawn)
    assert not view.rgb[~drawn].any()


@BOTH
def test_the_nearer_of_two_covers_the_farther_one(renderer):
    near, far = (
        ball(z=2.0, opacity=0.6, color=(1.0, 0.0, 0.0)),
        ball(z=4.0, opacity=0.5, color=(0.0, 1.0, 0.0)),
    )
    view = renderer.render([far, near], CAMERA)
    assert float(view.alpha[16, 16]) == pytest.approx(0.6 + 0.4 * 0.5)
    assert float(view.depth[16, 16]) == pytest.approx((0.6 * 2 + 0.2 * 4) / 0.8)
    torch.testing.assert_close(
        view.rgb[16, 16], linear_to_srgb(torch.tensor([0.6, 0.2, 0.0])), atol=1e-6, rtol=0
    )
    red, green = ball(opacity=0.9, color=(1.0, 0.0, 0.0)), ball(opacity=0.9, color=(0.0, 1.0, 0.0))
    middle = renderer.render([red, green], CAMERA).rgb[
        16, 16
    ]  # Gaussians of equal depth keep their order
    assert middle[0] > middle[1]


@BOTH
def test_blending_stops_before_a_pixel_is_full(renderer):
    stack = [ball(z=z, opacity=1.0, color=(0.5, z / 10, 0.0)) for z in (2.0, 3.0, 4.0)]
    view = renderer.render(stack, CAMERA)
    assert float(view.alpha[16, 16]) == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert float(view.depth[16, 16]) == pytest.approx(2.0, abs=1e-5)


@BOTH
def test_gaussians_before_the_near_plane_are_skipped(renderer):
    empty = Gaussians.empty()
    for drawn in (ball(z=-2.0), ball(z=0.0), ball(z=math.nan), empty, [], [empty, empty]):
        view = renderer.render(drawn, CAMERA)
        assert view.rgb.shape == (33, 33, 3)
        assert not any(image.any() for image in view.tensors)

    # The near plane is 1e-4 of the depth of the scene, here of 200 balls that are out of view.
    scene = [ball(x=90.0, z=2.0, sigma=1e-3)] * 200
    for size in (1e-6, 1.0, 1e6):
        for z, is_drawn in ((1.9e-4, False), (2.1e-4, True)):
            near = scaled(Gaussians.cat([*scene, ball(z=z, sigma=4e-6)]), size)
            assert bool(renderer.render(near, CAMERA).alpha.any()) == is_drawn


def scaled(gaussians: Gaussians, size: float) -> Gaussians:
    """The scene in another unit of length: 1000 for millimetres if it was in metres."""
    return dataclasses.replace(
        gaussians, means=gaussians.means * size, scales=gaussians.scales * size
    )


@BOTH
@pytest.mark.parametrize("size", [2.0**-20, 2.0**-10, 2.0**10, 2.0**20])
def test_a_scene_in_another_unit_gives_the_same_picture_bit_by_bit(renderer, size):
    scene = random_scene(4, 200, CAMERA)
    moved = turned_camera(50, 40, 45.0)
    for camera in (CAMERA, moved):
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= size
        view = renderer.render(scene, camera)
        other = renderer.render(
            scaled(scene, size), dataclasses.replace(camera, world_to_camera=pose)
        )
        assert view.alpha.any()
        assert torch.equal(other.rgb, view.rgb)
        assert torch.equal(other.alpha, view.alpha)
        assert torch.equal(other.depth, view.depth * size)


def test_the_near_plane_comes_from_all_sets_as_if_they_were_one():
    scene = random_scene(5, 9000, CAMERA)
    whole = near_plane([scene], CAMERA)
    for cuts in ([3000], [1, 2, 8999], [0, 4500]):
        edges = [0, *cuts, 9000]
        parts = [scene.select(slice(a, b)) for a, b in pairwise(edges)]
        assert near_plane(parts, CAMERA) == whole
    z = scene.means[:, 2][scene.means[:, 2] > 0]
    assert whole == pytest.approx(NEAR_PLANE_RATIO * float(z.quantile(0.01)), rel=0.2)


@BOTH
def test_eps2d_widens_the_projected_covariance(renderer):
    alpha = renderer.render(ball(), CAMERA, eps2d=0.3).alpha
    assert float(alpha[16, 18]) == pytest.approx(0.5 * math.exp(-4 / (2 * 4.3)), abs=1e-6)
    assert not renderer.render(ball(sigma=0.0), CAMERA).alpha.any()
    alpha = renderer.render(ball(sigma=0.0), CAMERA, eps2d=0.5).alpha
    assert alpha[16, 16:18].tolist() == pytest.approx([0.5, 0.5 * math.exp(-1)], abs=1e-6)


BAD = [*product(range(5), (math.nan, math.inf, -math.inf)), *product((0, 2, 3, 4), (1e38, -1e38))]


@pytest.mark.parametrize(("field", "bad"), BAD)
def test_bad_values_are_skipped(field, bad):
    camera = turned_camera(50, 40, 45.0)
    scene = random_scene(1, 300, camera)  # more than a block of the projection
    spoiled = [t.clone() for t in scene.tensors]
    spoiled[field][::2] = bad
    assert same_bits(
        CPU.render(Gaussians(*spoiled), camera), CPU.render(scene.select(slice(1, None, 2)), camera)
    )
    leaf = with_grad(Gaussians(*spoiled))
    backward(CPU.render(leaf, camera))
    assert all(t.grad.isfinite().all() for t in leaf.tensors)


def test_bad_tiles_and_devices_are_refused():
    for renderer in (CPU, TWIN):
        with pytest.raises(ValueError, match="tiles has shape"):
            renderer.render(ball(), CAMERA, tiles=torch.ones(2, 2, dtype=torch.bool))
    assert isinstance(get_renderer("cpu"), CpuRenderer)
    with pytest.raises(InputError, match="abacus"):
        get_renderer("abacus")


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Gaussians, Camera, float, float]:
    """Gaussians with or without harmonics, a camera, eps2d, and the share of opaque Gaussians."""
    camera = turned_camera(
        draw(st.integers(1, 50)), draw(st.integers(1, 50)), draw(st.floats(20, 90))
    )
    solidity, eps2d = draw(st.sampled_from([1.0, 10.0])), draw(st.sampled_from([0.0, 0.3]))
    gaussians = random_scene(draw(SEEDS), draw(st.integers(1, 80)), camera, solidity)
    degree = draw(st.sampled_from([0, 0, 1, 2, 3]))
    if degree:
        harmonics = random_harmonics(len(gaussians), degree, draw(SEEDS))
        gaussians = dataclasses.replace(gaussians, harmonics=harmonics)
    return gaussians, camera, eps2d, solidity


def held_to_the_twin(gaussians: Gaussians, camera: Camera, eps2d: float) -> Rendering:
    fast = CPU.render(gaussians, camera, eps2d=eps2d)
    slow = TWIN.render(gaussians.to(dtype=torch.float64), camera, eps2d=eps2d)
    sturdy = sturdy_pixels(gaussians, camera, eps2d)
    assert (~sturdy).sum() <= 2 + 0.02 * sturdy.numel()
    for name in FIELDS:
        found, expected = getattr(fast, name).double(), getattr(slow, name)
        torch.testing.assert_close(
            found[sturdy], expected[sturdy], rtol=1e-5, atol=1e-5, msg=lambda m, n=name: n + m
        )
    return fast


@settings(max_examples=25, deadline=None)
@given(scenes())
def test_images_match_the_reference(scene):
    gaussians, camera, eps2d, _ = scene
    fast = held_to_the_twin(gaussians, camera, eps2d)
    parts = [gaussians.select(slice(0, 9)), Gaussians.empty(), gaussians.select(slice(9, None))]
    assert same_bits(CPU.render(parts, camera, eps2d=eps2d), fast)


@pytest.mark.parametrize(
    "count",
    [0, BLOCK_GAUSSIANS - 1, BLOCK_GAUSSIANS, BLOCK_GAUSSIANS + 1, 3 * BLOCK_GAUSSIANS + 50],
)
def test_any_number_of_blocks_matches_the_reference(count):
    camera = turned_camera(50, 40, 45.0)
    scene = random_scene(count, count, camera, sizes=(1e-2, 4.0))
    held_to_the_twin(dataclasses.replace(scene, opacities=0.05 * scene.opacities), camera, 0.0)


@pytest.mark.parametrize("stretch", [(1e3, 1, 1), (1, 1e3, 1), (1, 1, 1e-9), (1e3, 1e3, 1e-6)])
def test_needles_and_edge_on_discs_match_the_reference(stretch):
    camera = turned_camera(50, 40, 45.0)
    scene = random_scene(5, 60, camera)
    thin = dataclasses.replace(
        scene, scales=scene.scales * torch.tensor(stretch), opacities=0.2 * scene.opacities
    )
    assert held_to_the_twin(thin, camera, 0.0).alpha.count_nonzero() > 100


@settings(max_examples=15, deadline=None)
@given(scenes())
def test_gradients_match_the_reference(scene):
    gaussians, camera, eps2d, _ = scene
    sturdy = sturdy_pixels(gaussians, camera, eps2d)
    # With one weighting, contributions of pixels may cancel; with several, this is unlikely.
    weights = torch.randn(
        4, *sturdy.shape, 5, generator=torch.Generator().manual_seed(len(gaussians))
    )
    weights *= sturdy[..., None]
    gradients = []
    for renderer, dtype in ((CPU, torch.float32), (TWIN, torch.float64)):
        leaf = with_grad(gaussians.to(dtype=dtype))
        view = renderer.render(leaf, camera, eps2d=eps2d)
        images = torch.cat([view.rgb, view.depth[..., None], view.alpha[..., None]], dim=-1)
        rows = [
            torch.autograd.grad((images * w).sum(), leaf.tensors, retain_graph=True)
            for w in weights
        ]
        gradients.append([torch.stack(column).double() for column in zip(*rows, strict=True)])
    names = [name for name, tensor in vars(gaussians).items() if tensor is not None]
    for name, found, expected in zip(names, *gradients, strict=True):
        scale = float(expected.abs().max())
        torch.testing.assert_close(
            found, expected, rtol=1e-4, atol=1e-4 * scale, msg=lambda m, n=name: n + m
        )


def test_gradients_survive_long_lists_of_faint_gaussians():
    camera = turned_camera(20, 18, 30.0)
    scene = random_scene(5, 600, camera)
    scene = dataclasses.replace(scene, opacities=0.05 * scene.opacities)
    weights = sturdy_pixels(scene, camera, 0.0).double()
    found, expected = (
        torch.autograd.grad((r.render(s, camera).alpha * weights.to(s.means)).sum(), s.tensors[:4])
        for r, s in ((CPU, with_grad(scene)), (TWIN, with_grad(scene.to(dtype=torch.float64))))
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(
            one.double(), other, rtol=1e-4, atol=1e-4 * float(other.abs().max())
        )


def test_reference_gradients_match_finite_differences():
    camera = turned_camera(7, 6, 6.0)
    scene = random_scene(3, 4, camera, dtype=torch.float64)
    assert sturdy_pixels(scene, camera, 0.1).all()

    def images(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        view = TWIN.render(Gaussians(*tensors), camera, eps2d=0.1)
        return view.rgb, view.depth, view.alpha

    assert torch.autograd.gradcheck(images, with_grad(scene).tensors, eps=1e-7, atol=1e-5)


def test_approximated_functions_are_accurate():
    powers = np.linspace(-30, 2, 4001, dtype=np.float32)
    found = np.array([exp2(x) for x in powers])
    np.testing.assert_allclose(found, np.exp2(powers.astype(np.float64)), rtol=5e-7)
    near_one = 1 + np.random.default_rng(0).normal(size=200) * 1e-6
    numbers = np.float32(
        [*np.geomspace(1e-37, 1e30, 3001), *np.linspace(0.65, 1.5, 3001), 1, ALPHA_MIN, *near_one]
    )
    found = np.array([natural_log(x) for x in numbers])
    np.testing.assert_allclose(found, np.log(numbers.astype(np.float64)), rtol=4e-16, atol=0)
    values = torch.cat(
        [torch.linspace(-0.1, 1.1, 4001), torch.tensor([0.0, 0.0031308, 0.0031309, 1.0])]
    )
    encoded = torch.tensor([encode_srgb(x) for x in values.numpy()])
    torch.testing.assert_close(encoded, linear_to_srgb(values), atol=1e-6, rtol=0)
    values = torch.cat([values, torch.tensor([0.04045, 0.040451])])
    decoded = torch.tensor([decode_srgb(x) for x in values.numpy()])
    torch.testing.assert_close(decoded, srgb_to_linear(values), atol=0, rtol=2e-6)


@settings(max_examples=15, deadline=None)
@given(scenes(), SEEDS)
def test_wanted_tiles_match_the_full_image(scene, tile_seed):
    gaussians, camera, eps2d, _ = scene
    shape = -(-camera.height // TILE_PX), -(-camera.width // TILE_PX)
    tiles = torch.rand(shape, generator=torch.Generator().manual_seed(tile_seed)) < 0.5
    onto = Rendering(*(torch.rand(camera.height, camera.width, *rest) for rest in ((3,), (), ())))
    kept = [image.clone() for image in onto.tensors]
    full = CPU.render(gaussians, camera, eps2d=eps2d)
    part = CPU.render(gaussians, camera, eps2d=eps2d, tiles=tiles, previous_rendering=onto)
    black = CPU.render(gaussians, camera, eps2d=eps2d, tiles=tiles)
    mask = tile_mask(tiles, camera)
    for drawn, found, before, after, empty in zip(
        full.tensors, part.tensors, kept, onto.tensors, black.tensors, strict=True
    ):
        assert torch.equal(found[mask], drawn[mask])
        assert torch.equal(found[~mask], before[~mask])
        assert torch.equal(after, before)
        assert not empty[~mask].any()


@settings(max_examples=15, deadline=None)
@given(scenes(), SEEDS)
def test_untouched_tiles_do_not_change(scene, more_seed):
    gaussians, camera, _, solidity = scene
    more = random_scene(more_seed, 5, camera, solidity)
    before, after = CPU.render(gaussians, camera), CPU.render([gaussians, more], camera)
    tiles = touched_tiles(more, camera)
    mask = tile_mask(tiles, camera)
    alone = CPU.render(more, camera).alpha > 0
    assert all(
        torch.equal(one[~mask], other[~mask])
        for one, other in zip(after.tensors, before.tensors, strict=True)
    )
    assert not (alone & ~mask).any()
    assert not touched_tiles(more.select(torch.zeros(len(more), dtype=torch.bool)), camera).any()


def test_gradients_of_tiles():
    camera = turned_camera(40, 40, 40.0)
    leaf = with_grad(random_scene(4, 50, camera))
    tiles = torch.zeros(3, 3, dtype=torch.bool)
    tiles[1, 1] = True
    mask = tile_mask(tiles, camera)
    onto = Rendering(*(torch.rand(40, 40, *rest).requires_grad_() for rest in ((3,), (), ())))
    part = CPU.render(leaf, camera, tiles=tiles, previous_rendering=onto)
    backward(part)
    for image in onto.tensors:
        assert not image.grad[mask].any()
        assert (image.grad[~mask] == 1).all()
    twin = with_grad(leaf.detach())
    full = CPU.render(twin, camera)
    (full.rgb[mask].sum() + full.depth[mask].sum() + full.alpha[mask].sum()).backward()
    for one, other in zip(leaf.tensors, twin.tensors, strict=True):
        torch.testing.assert_close(one.grad, other.grad)


def test_colours_change_with_the_view_and_with_nothing_else():
    camera = turned_camera(60, 50, 50.0)
    plain = random_scene(8, 300, camera)
    colourful = dataclasses.replace(plain, harmonics=random_harmonics(300, 3))
    aux = random_scene(9, 20, camera)
    one, other = CPU.render(plain, camera), CPU.render(colourful, camera)
    assert torch.equal(one.alpha, other.alpha)
    assert torch.equal(one.depth, other.depth)
    assert float((one.rgb - other.rgb).abs().max()) > 0.1
    # Joined to others, which get coefficients of 0, a Gaussian has the same bits.
    together = CPU.render(Gaussians.cat([colourful, aux]), camera)
    assert same_bits(CPU.render([colourful, aux], camera), together)
    assert same_bits(CPU.render(plain.with_harmonics_count(15), camera), one)
    # A coefficient that is not finite hides its Gaussian, as another such number does.
    colourful.harmonics[5, 7, 1] = torch.nan
    assert same_bits(
        CPU.render(colourful, camera), CPU.render(colourful.select(torch.arange(300) != 5), camera)
    )


def test_results_do_not_depend_on_the_number_of_threads():
    camera = turned_camera(130, 100, 100.0)
    scene = random_scene(6, 2000, camera)
    results = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 2, 5):
            torch.set_num_threads(count)
            leaf = with_grad(scene)
            view = CPU.render(leaf, camera)
            (view.rgb.square().sum() + view.depth.sum() + view.alpha.sum()).backward()
            results.append([*view.tensors, *(t.grad for t in leaf.tensors)])
    finally:
        torch.set_num_threads(threads)
    with ThreadPoolExecutor(4) as pool:  # several Python threads render at once
        together = list(pool.map(lambda _: CPU.render(scene, camera), range(8)))
    for result in results[1:] + [[*view.tensors] for view in together]:
        assert all(torch.equal(one, other) for one, other in zip(results[0], result, strict=False))


def test_frozen_sets_get_no_gradients():
    camera = turned_camera(100, 80, 80.0)
    frozen, aux = random_scene(8, 400, camera), with_grad(random_scene(9, 3, camera))
    both = with_grad(Gaussians.cat([frozen, aux.detach()]))
    weights = torch.rand(80, 100)
    for scene in ([frozen, aux], both):
        (CPU.render(scene, camera).alpha * weights).sum().backward()
    assert all(t.grad is None for t in frozen.tensors)
    for one, other in zip(aux.tensors, both.tensors, strict=True):
        torch.testing.assert_close(one.grad, other.grad[400:])


@BOTH
def test_a_batch_of_views_equals_single_views(renderer):
    cameras = [
        turned_camera(40, 33, 40.0),
        turned_camera(40, 33, 60.0),
        turned_camera(40, 33, 50.0),
    ]
    scene = random_scene(4, 30, cameras[0])
    scenes = [[scene], [], [scene.select(slice(0, 9)), scene.select(slice(9, None))]]
    tiles = [None, torch.ones(3, 3, dtype=torch.bool), torch.eye(3, dtype=torch.bool)]
    previous = [None, None, renderer.render(scene, cameras[0])]
    together = renderer.render_batch(
        scenes, cameras, eps2d=0.3, tiles=tiles, previous_renderings=previous
    )
    for k, rendering in enumerate(together):
        alone = renderer.render(
            scenes[k], cameras[k], eps2d=0.3, tiles=tiles[k], previous_rendering=previous[k]
        )
        assert same_bits(rendering, alone)
    plain = renderer.render_batch(scenes[:1], cameras[:1])
    assert same_bits(plain[0], renderer.render(scenes[0], cameras[0]))
    with pytest.raises(ValueError, match="one size"):
        renderer.render_batch([[scene]] * 2, [CAMERA, cameras[0]])


def test_renderers_name_their_device():
    assert CPU.device == TWIN.device == torch.device("cpu")


@pytest.mark.parametrize("max_entries", [1, 700, 20_000])
def test_a_picture_drawn_in_blocks_of_tiles_is_the_same_bit_by_bit(monkeypatch, max_entries):
    camera = turned_camera(130, 100, 100.0)
    scene = random_scene(6, 2000, camera)
    # Equal depths keep the order of the Gaussians.
    twins = Gaussians.cat([scene, dataclasses.replace(scene, colors=scene.colors.flip(0))])
    tiles = torch.rand(7, 9, generator=torch.Generator().manual_seed(3)) < 0.7
    whole = CPU.render(twins, camera)
    some = CPU.render(twins, camera, tiles=tiles)
    monkeypatch.setattr("spackle.render.drawing.MAX_ENTRIES_AT_ONCE", max_entries)
    assert same_bits(CPU.render(twins, camera), whole)
    assert same_bits(CPU.render(twins, camera, tiles=tiles), some)


def test_lists_of_huge_gaussians_are_never_in_memory_all_together(monkeypatch):
    lengths = np.random.default_rng(0).integers(0, 50, (12, 17))
    for max_entries in (1, 49, 300, 10**6):
        seen = np.zeros_like(lengths)
        for block in tile_blocks(lengths, max_entries):
            tiles = block.drawn(np.ones(lengths.shape, np.bool_))
            seen += tiles
            assert lengths[tiles].sum() <= max_entries or tiles.sum() == 1
        assert (seen == 1).all()
