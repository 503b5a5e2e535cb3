"""Silhouettes in two layers: what is found, what is blended, and what is lifted."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scenes import Scene, box_before_wall, psnr, slanted_plane
from torch.nn.functional import avg_pool2d

from spackle.bases import silhouettes as S
from spackle.bases.blending import OPACITY, WEIGHTS, Mixture, blended_opacities
from spackle.bases.quadtree import LEVELS
from spackle.bases.silhouettes import find_layers
from spackle.bases.splats import layered_gaussians
from spackle.camera import Camera
from spackle.camera_path import DepthRange, extremes
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.render import CpuRenderer
from spackle.surface import EDGE, surface_gaussians

Image = np.ndarray
CPU = CpuRenderer()


def around(shape: tuple[int, ...], y: int, x: int, reach: int) -> list[tuple[int, int]]:
    rows, columns = (range(max(p - reach, 0), min(p + reach + 1, n)) for p, n in zip((y, x), shape, strict=False))
    return list(itertools.product(rows, columns))


def plain_rings(inverse: Image) -> tuple[Image, dict[tuple[int, int], tuple[float, float]]]:
    """Rings, and the two inverse depths of the highest step beside each pixel of the first ring."""
    levels: dict[tuple[int, int], tuple[float, float]] = {}
    for p in itertools.product(*map(range, inverse.shape)):
        for q in around(inverse.shape, *p, 1):
            high, low = max(inverse[p], inverse[q]), min(inverse[p], inverse[q])
            beside = abs(p[0] - q[0]) + abs(p[1] - q[1]) == 1
            jump = inverse[q] - inverse[p]
            beyond = [(2 * a[0] - b[0], 2 * a[1] - b[1]) for a, b in ((p, q), (q, p))]
            inner = [min(r) >= 0 and r[0] < inverse.shape[0] and r[1] < inverse.shape[1] for r in beyond]
            goes_on = [
                way * (inverse[r] - inverse[a]) if i else jump
                for way, r, a, i in zip((-1, 1), beyond, (p, q), inner, strict=True)
            ]
            if min(g * jump for g in goes_on) > S.STEADILY * jump**2:
                continue
            if beside and high - low > EDGE * low and high - low > np.subtract(*levels.get(p, (0, 0))):
                levels[p] = high, low
    ring = np.zeros(inverse.shape, np.uint8)
    for p in itertools.product(*map(range, inverse.shape)):
        away = [max(abs(p[0] - q[0]), abs(p[1] - q[1])) + 1 for q in levels]
        ring[p] = min(away, default=0) if min(away, default=9) <= S.REACH else 0
    return ring, levels


def plain_layers(inverse: Image, slope: Image, colors: Image) -> S.Layers:
    """See `find_layers`; one pixel at a time, planes by least squares with a ridge."""
    ring, levels = plain_rings(inverse)
    inside, texture = np.zeros(inverse.shape), np.zeros((2, *inverse.shape))
    depth, slopes, mean = (np.stack([image, image]).astype(float) for image in (inverse, slope, colors))
    zone = [(int(y), int(x)) for y, x in np.argwhere(ring)]
    for p in zone:
        high, low = levels[
            min((q for q in around(ring.shape, *p, S.REACH) if q in levels), key=lambda q: math.dist(p, q))
        ]
        middle = (high + low) / 2
        close = around(ring.shape, *p, S.REACH)
        blur = [math.exp(-(math.dist(p, q) ** 2) / (2 * S.BLUR**2)) for q in close]
        part = np.clip(np.average([inverse[q] > middle for q in close], weights=blur), 0.02, 0.98)
        inside[p] = S.BLUR * math.log(part / (1 - part)) / 1.702
        near = inverse[p] > middle
        inside[p] = max(inside[p], S.SURE) if near else min(inside[p], -S.SURE)
        for side, level in enumerate((inverse[p], low) if near else (high, inverse[p])):
            seen = [q for q in around(ring.shape, *p, S.WINDOW) if (inverse[q] > middle) == (side == 0)]
            seen = [q for q in seen if low - (middle - low) <= inverse[q] <= high + (high - middle)]
            fall = np.array([math.exp(-(math.dist(p, q) ** 2) / S.FALL**2) for q in seen])
            pure = fall * [S.PURE[ring[q]] for q in seen]
            if len(seen):
                mean[side][p] = np.average([colors[q] for q in seen], axis=0, weights=pure)
                texture[side][p] = np.average(
                    [(colors[q] - mean[side][p]) ** 2 for q in seen], axis=0, weights=pure
                ).sum()
            if (near and (side == 1 or ring[p] <= S.RIM)) or (not near and side == 0):
                like = [abs(inverse[q] - level) < 2 * EDGE * inverse[q] for q in seen]
                weight = fall * [S.STEADY[ring[q]] for q in seen] * like
                depth[side][p], slopes[side][p] = level, 0
                if weight.sum() > 1e-6:
                    weight = weight / weight.sum()
                    xy, d = np.array([(q[1] - p[1], q[0] - p[0]) for q in seen]), np.array([inverse[q] for q in seen])
                    xy0, d0 = weight @ xy, weight @ d
                    spread = (xy - xy0).T @ np.diag(weight) @ (xy - xy0) + 0.3 * np.eye(2)
                    found = np.linalg.solve(spread, (xy - xy0).T @ (weight * (d - d0)))
                    slopes[side][p] = np.clip(found, -S.STEEPEST * d0, S.STEEPEST * d0)
                    depth[side][p] = max(d0 - slopes[side][p] @ xy0, d0 / 2)
    alpha = np.zeros(inverse.shape)
    for p in zone:
        costs = {}
        for ramp, shift in itertools.product(S.RAMPS, range(-S.STEPS, S.STEPS + 1)):
            costs[ramp, shift] = S.SHIFT_COST * shift**2
            for q in around(ring.shape, *p, S.AROUND):
                if ring[q]:
                    apart = mean[0][q] - mean[1][q]
                    own = colors[q] - mean[1][q]
                    share = apart @ own / max(apart @ apart, 1e-9)
                    beside = S.ASTRAY * max(own @ own - share * (apart @ own), 0)
                    weight = apart @ apart / (S.VARIED * (texture[:, q[0], q[1]].sum() + beside) + S.NOISE)
                    off = np.clip(0.5 + (inside[q] + shift * S.STEP) / ramp, 0, 1) - share
                    costs[ramp, shift] += weight * min(off**2, S.OUTLIER)
        ramp, best = min(costs, key=costs.__getitem__)
        shift = float(best)
        if abs(best) < S.STEPS:
            before, after = costs[ramp, best - 1], costs[ramp, best + 1]
            bend = before - 2 * costs[ramp, best] + after
            shift += 0.5 * (before - after) / bend if bend > 0 else 0
        alpha[p] = np.clip(0.5 + (inside[p] + shift * S.STEP) / ramp, 0, 1)
    for p in zone:
        pure = mean[:, p[0], p[1]].copy()
        shares = np.array([alpha[p], 1 - alpha[p]])
        rest = colors[p] - shares @ mean[:, p[0], p[1]]
        for side, share in enumerate(shares):
            limit = S.MARGIN + S.TEXTURE * math.sqrt(texture[side][p])
            change = np.clip(rest * share**2 / (shares**3).sum(), -limit, limit)
            mean[side][p] = np.clip(mean[side][p] + change, 0, 1)
        apart, own = pure[0] - pure[1], colors[p] - pure[1]
        share = apart @ own / max(apart @ apart, 1e-9)
        if inside[p] <= 0 and share < 0 and own @ own > S.FRINGE * texture[1][p] + S.UNEXPLAINED:
            alpha[p] = 1
        elif ((colors[p] - shares @ mean[:, p[0], p[1]]) ** 2).sum() > S.UNEXPLAINED:
            if 0 < share < 1 and ((own - share * apart) ** 2).sum() <= S.UNMIXED:
                alpha[p], mean[:, p[0], p[1]] = share, pure
            else:
                alpha[p] = inside[p] > 0
    return S.Layers(ring, alpha, depth, slopes, mean)


def steps(seed: int, height: int = 15, width: int = 17) -> tuple[Image, Image, Image]:
    """Inverse depth with steps along random lines, slopes, and colours that follow it with blur and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    inverse = 0.2 + 0.002 * x + 0.001 * rng.random((height, width))
    for level in (0.4, 0.6)[: 1 + seed % 2]:
        a, b, c = rng.normal(size=3)
        inverse[a * (x - width / 2) + b * (y - height / 2) > 3 * c] += level
    colors = np.clip(
        np.stack([inverse, 1 - inverse, 0.5 + 0 * inverse], -1) + 0.05 * rng.normal(size=(height, width, 3)), 0, 1
    )
    colors[1:] = 0.6 * colors[1:] + 0.4 * colors[:-1]
    return inverse.astype(np.float32), np.zeros((height, width, 2), np.float32), colors.astype(np.float32)


@pytest.mark.parametrize("seed", range(1, 5))
def test_the_layers_are_those_of_the_plain_way(seed: int) -> None:
    made = steps(seed)
    found, plain = find_layers(*made), plain_layers(*made)
    assert 0 < np.count_nonzero(found.ring) < found.ring.size
    assert np.array_equal(found.ring, plain.ring)
    for field in ("alpha", "depth", "slope", "color"):
        np.testing.assert_allclose(getattr(found, field), getattr(plain, field), rtol=2e-3, atol=2e-4)


def blended(scene_alpha: float = 0.35) -> Scene:
    """A dark box before a bright wall, its border halfway between pixels' sides: photo of four times the resolution."""
    fine = box_before_wall(width=384, height=288, focal=320)
    near = fine.depth < 3
    near[:, 128:130] = False  # the left border lies half a pixel further in
    rgb = torch.where(near[..., None], torch.tensor([0.1, 0.1, 0.4]), torch.tensor([0.8, 0.9, 0.5]))
    mixed = avg_pool2d(srgb_to_linear(rgb).movedim(-1, 0), 4).movedim(0, -1)
    share = avg_pool2d(near.float()[None], 4)[0]
    return Scene(linear_to_srgb(mixed), torch.where(share >= 0.5, 2.0, 6.0), Camera.from_focal(80, 96, 72))


def test_a_mixed_pixel_is_taken_apart_and_put_together_again() -> None:
    scene = blended()
    colors = srgb_to_linear(scene.rgb)
    found = find_layers((1 / scene.depth).numpy(), np.zeros((72, 96, 2), np.float32), colors.numpy())
    column = found.alpha[30:42, 32]  # the pixels of which the box has a half
    assert column == pytest.approx(0.5, abs=0.06)
    assert found.alpha[30:42, 36] == pytest.approx(0) or found.ring[36, 36] == 0
    near, far = srgb_to_linear(torch.tensor([[0.1, 0.1, 0.4], [0.8, 0.9, 0.5]])).numpy()
    assert np.abs(found.color[0, 30:42, 32] - near).max() < 0.05
    assert np.abs(found.color[1, 30:42, 32] - far).max() < 0.05
    base = scene.lift(LEVELS).gaussians
    assert psnr(CPU.render(base, scene.camera).rgb, scene.rgb) > 32
    for view in extremes(scene.camera, 0.3, DepthRange.of(base)):
        seen = CPU.render(base, view)
        wall = (seen.depth > 5) & (seen.alpha > 0.95)
        assert float(seen.rgb[wall].amin()) > 0.42  # nothing of the box's colour stays on the wall


def test_a_fringe_that_a_camera_has_sharpened_goes_with_the_thing() -> None:
    """Brighter than the wall along a dark box; on the wall it would be a thin line as soon as the camera moves."""
    scene = blended()
    scene.rgb[:, 31][scene.depth[:, 32] < 3] = torch.tensor([1.0, 1.0, 0.9])
    base = scene.lift(LEVELS).gaussians
    assert psnr(CPU.render(base, scene.camera).rgb, scene.rgb) > 32
    for view in extremes(scene.camera, 0.3, DepthRange.of(base)):
        seen = CPU.render(base, view)
        wall = (seen.depth > 5) & (seen.alpha > 0.95)
        assert float(seen.rgb[wall][:, 2].amax()) < 0.6


@pytest.mark.parametrize("seed", range(3))
def test_opacities_blend_to_the_shares(seed: int) -> None:
    inverse, slope, colors = steps(seed)
    layers = find_layers(inverse, slope, colors)
    opacity = blended_opacities(layers.alpha, layers.ring)
    for y, x in np.argwhere((layers.ring > 0) & (opacity > 0) & (opacity < 1)):
        passes = 1.0
        for k, (dy, dx) in enumerate(itertools.product((-1, 0, 1), repeat=2)):
            v, u = min(max(y + dy, 0), inverse.shape[0] - 1), min(max(x + dx, 0), inverse.shape[1] - 1)
            if k != 4 and layers.ring[v, u]:
                passes *= 1 - OPACITY * WEIGHTS[k] * opacity[v, u]
        assert 1 - passes * (1 - opacity[y, x]) == pytest.approx(layers.alpha[y, x], abs=0.03)


def test_a_mixture_is_what_the_renderer_shows() -> None:
    torch.manual_seed(0)
    n, camera = 300, Camera.from_focal(40, 40, 300)  # more rows than one thread takes
    uv, spread = torch.rand(n, 2) * torch.tensor([44, 308]) - 4, 0.4 + 3 * torch.rand(n, 2)
    depth, opacity, colors = 0.2 + torch.rand(n), 0.2 + 0.79 * torch.rand(n), torch.rand(n, 3)
    mixed = Mixture(uv, depth, spread, opacity, 300, 40).picture(colors)
    gaussians = surface_gaussians(camera, uv, depth, torch.zeros(n, 2), spread, colors, opacity)
    assert psnr(linear_to_srgb(mixed), CPU.render(gaussians, camera).rgb) > 50
    plain, passes = torch.zeros(300, 40, 3), torch.ones(300, 40)
    for i in depth.argsort(descending=True).tolist():
        away = ((camera.pixel_centers() - uv[i]) / spread[i]).square().sum(-1)
        alpha = opacity[i] * (-0.5 * away).exp()
        alpha = torch.where(alpha >= 1 / 255, alpha, 0)
        full = passes * (1 - alpha) <= 1e-4
        plain += torch.where(full, 0, passes * alpha)[..., None] * colors[i]
        passes = torch.where(full, 0, passes * (1 - alpha))
    torch.testing.assert_close(mixed, plain, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("cells", [2, 3, 7])
def test_there_are_never_more_gaussians_than_three_for_two_pixels(cells: int) -> None:
    """Also where every pixel is beside a step."""
    y, x = torch.meshgrid(torch.arange(42) // cells, torch.arange(50) // cells, indexing="ij")
    near = ((x + y) % 2).bool()
    colors = torch.where(near[..., None], 0.9, 0.1) + 0.05 * torch.rand(42, 50, 3)
    base = layered_gaussians(torch.where(near, 0.5, 0.2), colors, Camera.from_focal(60, 50, 42))
    assert 42 * 50 <= len(base) <= 42 * 50 * 3 // 2
    assert float(CPU.render(base, Camera.from_focal(60, 50, 42)).alpha.min()) > 0.95


def test_a_surface_without_steps_has_one_layer_that_gives_the_photo_back() -> None:
    scene = slanted_plane(2, 4, 1)
    counts = []
    for levels in (0, LEVELS):
        base = scene.lift(levels).gaussians
        counts.append(len(base) / scene.depth.numel())
        assert psnr(CPU.render(base, scene.camera).rgb, scene.rgb) > 45
    assert counts[0] == 1.25
    assert counts[1] < 0.8
