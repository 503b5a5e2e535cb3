"""Training views for the residual whose targets are true: second views of made worlds.

A world's photo is lifted to Gaussians, by one of three depths (`BASES`), and rendered at a second
camera. Its holes are real, and the world's second view shows what belongs in them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.bases.lite import MAX_DEPTH_RATIO, MIN_OUTLINE_GROWTH_PX, LiteBase
from spackle.core.filters import gaussian_blur
from spackle.depth.depth_map import DepthMap
from spackle.paper.training.losses import hole_psnr
from spackle.paper.training.sample_factory import Source
from spackle.paper.training.samples import Sample
from spackle.render import Renderer
from spackle.runtime.errors import InputError
from worlds.shards import StoredView, read_view, world_keys
from worlds.viewpoints import SECOND_VIEWS

Rng = np.random.Generator
Floats = NDArray[np.float32]
# What depth a photo is lifted by: the true one; the true one with outlines beside the photo's; or
# the guess of `lite`.
Base = Literal["true", "outlines", "guess"]
BASES: tuple[Base, ...] = get_args(Base)
SKY_RATIO = 4.0  # the sky lies so many times farther than the farthest surface
# Wrong outlines: `lite` sees outlines at ± 5 pixels of a photo with 448.
MAX_OUTLINE_ERROR_PX = 5.0
OUTLINE_ERROR_PX = 2.5  # standard deviation in x and in y
# An outline's error stays alike over so many pixels: from that of a table's leg to that of a sofa.
ERROR_WIDTHS_PX = (6.0, 30.0)
FIT_ROUNDS = 10  # of the fit of a guess; it changes by less than 1 % after that
# A base that shows the second view worse than this, outside of its holes, has its holes elsewhere
# than the truth, and things in the truth where its holes are.
MIN_AGREEMENT_DB = 15.0


def second_view_source(archive: Path, bases: Sequence[Base], renderer: Renderer) -> Source:
    """The second views of the worlds in an archive as training views, in the archive's order.

    The photos are lifted in turn by the depths of `bases`, one for each world. A view of which the
    base shows too little of the truth is refused with a ValueError.
    """
    views = [(key, 1 + number) for key in world_keys(archive) for number in range(SECOND_VIEWS)]
    # The views of a world follow each other, so the last base is kept.
    base_of = functools.lru_cache(maxsize=1)(functools.partial(_base, archive, tuple(bases)))

    def view_by_number(rng: Rng, index: int) -> Sample:
        """The view of this number; `rng` is not used, because the world alone determines it."""
        key, number = views[index]
        return second_view(base_of(key), read_view(archive, key, number), renderer)

    return Source(
        share=1.0,
        view=view_by_number,
        names=["worlds", archive.name, *bases],
        views=len(views),
    )


def second_view(base: BasePrediction, truth: StoredView, renderer: Renderer) -> Sample:
    """A training view: a world's base at a second camera, with the true view as the target.

    ValueError if the two do not agree outside of the holes, or there is no hole.
    """
    target = as_colors(truth.rgb)
    rendering = renderer.render(base.gaussians, truth.camera)
    assert base.photo is not None  # `base_of_world` sets it
    sample = Sample.of(
        base=base.gaussians,
        rendering=rendering,
        camera=truth.camera,
        photo_camera=base.camera,
        photo=base.photo,
        target=target,
    )
    if not sample.hole.any():
        raise ValueError("a second view without a hole")
    agreement = hole_psnr(rendering.rgb, target, ~sample.hole)
    if not agreement >= MIN_AGREEMENT_DB:
        raise ValueError(f"a base that does not fit its second view: {agreement:.0f} dB")
    return sample


def _base(archive: Path, bases: tuple[Base, ...], key: str) -> BasePrediction:
    """The base of a world; its number decides by which depth of `bases` it is lifted."""
    seed, number = (int(part) for part in key.split("-"))
    kind = bases[number % len(bases)]
    return base_of_world(read_view(archive, key, 0), kind, np.random.default_rng([seed, number]))


def base_of_world(photo: StoredView, kind: Base, rng: Rng) -> BasePrediction:
    """The Gaussians of a world's photo, lifted by a depth of this kind.

    `photo` is view 0 without a camera's noise: then its colours are those of the second views.
    `rng` draws the errors of outlines.
    """
    rgb = as_colors(photo.rgb)
    depth = with_far_sky(photo.depth)
    if kind == "guess":
        depth_map = guessed_depth(rgb, torch.from_numpy(1 / depth), _lite())
        # As `LiteBase` does it: outlines grow by a pixel of the map.
        map_pixel_px = max(rgb.shape[:2]) / max(depth_map.depth.shape)
        growth = max(MIN_OUTLINE_GROWTH_PX, round(map_pixel_px))
        return lift_rgbd(rgb, depth_map, photo.camera, outline_growth_px=growth)
    if kind == "outlines":
        depth = with_wrong_outlines(depth, rng)
    return lift_rgbd(rgb, as_depth_map(torch.from_numpy(depth)), photo.camera)


@functools.cache
def _lite() -> LiteBase:
    """The lite base, read once."""
    return LiteBase.load(device="cpu")


def as_colors(rgb: NDArray[np.uint8]) -> Tensor:
    """Colours [H, W, 3] in 0..1 of bytes."""
    return torch.from_numpy(rgb).float() / 255


def as_depth_map(depth: Tensor) -> DepthMap:
    """A depth map of metres [H, W] that are all known."""
    known = torch.ones_like(depth, dtype=torch.bool)
    return DepthMap(depth, known, None, None, "depth", Path("a world"))


def with_far_sky(depth: Floats) -> Floats:
    """The depth [H, W], with the sky, whose depth is 0, behind all surfaces.

    InputError if there is nothing but sky.
    """
    if not (depth > 0).any():
        raise InputError("a world whose photo shows nothing but sky")
    return np.where(depth > 0, depth, SKY_RATIO * depth.max()).astype(np.float32)


def with_wrong_outlines(depth: Floats, rng: Rng) -> Floats:
    """The depth [H, W] whose outlines lie up to 5 pixels beside those of the photo.

    Each pixel gets the depth of a pixel nearby. Offsets are random, and alike among neighbours.
    """
    height, width = depth.shape
    low, high = ERROR_WIDTHS_PX
    width_px = float(low * (high / low) ** rng.random())
    noise = torch.from_numpy(rng.standard_normal((height, width, 2)).astype(np.float32))
    smooth = gaussian_blur(noise[None], width_px)[0]
    offsets = OUTLINE_ERROR_PX * (smooth / smooth.std()).numpy()
    offsets = offsets.clip(-MAX_OUTLINE_ERROR_PX, MAX_OUTLINE_ERROR_PX).round().astype(int)
    row, column = np.mgrid[:height, :width]
    row = (row + offsets[..., 0]).clip(0, height - 1)
    column = (column + offsets[..., 1]).clip(0, width - 1)
    moved: Floats = depth[row, column]
    return moved


def guessed_depth(rgb: Tensor, inverse_depth: Tensor, lite: LiteBase) -> DepthMap:
    """The depth that `lite` guesses, scaled and shifted to the true one.

    The guess g of inverse depth is true up to a factor s and a shift t; s g + t has the least sum
    of absolute differences from the truth, so a few wrong surfaces do not move the others.

    Args:
        rgb: [H, W, 3] the photo.
        inverse_depth: [H, W] 1/m, the true one.
        lite: makes the guess.

    Raises:
        ValueError: the guess takes near for far.
    """
    guess = lite.inverse_depth(rgb)  # [h, w]
    height, width = inverse_depth.shape
    resized = interpolate(guess[None, None], (height, width), mode="bilinear")[0, 0]
    scale, shift = line_of_least_differences(resized.flatten(), inverse_depth.flatten())
    if scale <= 0:
        raise ValueError("lite takes near for far")
    fitted = scale * guess + shift
    # The shift may put far surfaces behind infinity; `lite` itself limits the ratio of depths.
    return as_depth_map(1 / fitted.clamp_min(float(fitted.max()) / MAX_DEPTH_RATIO))


def line_of_least_differences(x: Tensor, y: Tensor) -> tuple[float, float]:
    """s and t for which the sum of |s x + t - y| is least, for x and y [N].

    Weighted least squares, in which a pair counts by the inverse of its difference before.
    """
    points = torch.stack([x, torch.ones_like(x)], -1).double()  # [N, 2]
    values = y.double()
    weights = torch.ones_like(values)
    # Smaller differences count alike: their inverse would have no limit.
    floor = 1e-3 * float(values.std()) + 1e-12
    line = torch.zeros(2, dtype=torch.float64)
    for _ in range(FIT_ROUNDS):
        weighted = points * weights[:, None]
        line = torch.linalg.solve(weighted.T @ points, weighted.T @ values)
        weights = 1 / (points @ line - values).abs().clamp_min(floor)
    return float(line[0]), float(line[1])
