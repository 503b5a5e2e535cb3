"""Training views for the residual whose targets are true: second views of made worlds.

A world is a made room with exact depth, of which an archive holds view 0, the photo's, and six
second views. The photo is lifted to Gaussians, the *base*, by one of three depths (`DEPTH_KINDS`),
and rendered at a second camera. The holes in this rendering are real, and the world's second view,
the *true view*, shows what belongs in them.
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
# the guess of `lite`, the package's base from a single photo.
DepthKind = Literal["true", "outlines", "guess"]
DEPTH_KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
PHOTO_VIEW = 0  # the number of the photo's view in an archive; second views follow from 1
SKY_RATIO = 4.0  # the sky lies so many times farther than the farthest surface
# Wrong outlines: `lite` sees outlines within 5 pixels of the true ones in a photo whose longer side
# has 448 pixels, as those of worlds have.
MAX_OUTLINE_ERROR_PX = 5.0
OUTLINE_ERROR_PX = 2.5  # standard deviation in x and in y
# Range of the Gaussian's standard deviation over which an outline's error stays alike: from about
# the width of a table's leg to that of a sofa.
ERROR_WIDTHS_PX = (6.0, 30.0)
FIT_ROUNDS = 10  # of `line_of_least_differences`; the line changes by less than 1 % after that
# The least PSNR between a base's rendering and the true view, outside of holes. Below it, things
# lie elsewhere in the rendering than in the true view, and so do the holes.
MIN_AGREEMENT_DB = 15.0


def second_view_source(
    archive: Path, depth_kinds: Sequence[DepthKind], renderer: Renderer
) -> Source:
    """The second views of the worlds in an archive as training views, in the archive's order.

    Each training view has two sides: the base, which is the world's photo lifted to Gaussians,
    rendered at a second camera; and the true view from there, which the archive holds. The source
    raises a ValueError for a view whose two sides do not fit each other; see `second_view`.

    Args:
        archive: a file of made worlds.
        depth_kinds: what depths the photos are lifted by: the worlds' numbers go through them.
        renderer: renders the bases.
    """
    views = [
        (key, number)
        for key in world_keys(archive)
        for number in range(PHOTO_VIEW + 1, PHOTO_VIEW + 1 + SECOND_VIEWS)
    ]
    # The views of a world follow each other, so the last base is kept.
    base_of = functools.lru_cache(maxsize=1)(
        functools.partial(_base_of_key, archive, tuple(depth_kinds))
    )

    def view_by_number(rng: Rng, index: int) -> Sample:
        """The view of this number; `rng` is not used, because the world alone determines it."""
        key, number = views[index]
        return second_view(base_of(key), read_view(archive, key, number), renderer)

    return Source(
        share=1.0,  # all views come from here, because the source is used alone
        view=view_by_number,
        names=["worlds", archive.name, *depth_kinds],  # what determines the views
        views=len(views),
    )


def second_view(base: BasePrediction, true_view: StoredView, renderer: Renderer) -> Sample:
    """A training view: a world's base at a second camera, with the true view as the target.

    Args:
        base: the Gaussians of the world's photo, from `base_of_world`.
        true_view: what the second camera sees of the world.
        renderer: renders the base.

    Raises:
        ValueError: the base has no hole at this camera, or its rendering and the true view do not
            agree outside of the holes.
    """
    target = as_colors(true_view.rgb)
    rendering = renderer.render(base.gaussians, true_view.camera)
    assert base.photo is not None  # `base_of_world` sets it
    sample = Sample.of(
        base=base.gaussians,
        rendering=rendering,
        camera=true_view.camera,
        photo_camera=base.camera,
        photo=base.photo,
        target=target,
    )
    if not sample.hole.any():
        raise ValueError("a second view without a hole")
    # `hole_psnr` compares where its mask is set: here everywhere but in the holes.
    agreement = hole_psnr(rendering.rgb, target, ~sample.hole)
    if not agreement >= MIN_AGREEMENT_DB:
        raise ValueError(f"a base that does not fit its second view: {agreement:.0f} dB")
    return sample


def is_usable(base: BasePrediction, true_view: StoredView, renderer: Renderer) -> bool:
    """Whether `second_view` accepts a base and a true view: there are holes, and the rest fits."""
    try:
        second_view(base, true_view, renderer)
    except ValueError:
        return False
    return True


def _base_of_key(archive: Path, depth_kinds: tuple[DepthKind, ...], key: str) -> BasePrediction:
    """The base of a world: the Gaussians of its photo.

    Args:
        archive: the world's file.
        depth_kinds: of which the world's number chooses one, in turn.
        key: the world's, such as "00-000012": its seed and its number.
    """
    seed, number = (int(part) for part in key.split("-"))
    kind = depth_kinds[number % len(depth_kinds)]
    photo = read_view(archive, key, PHOTO_VIEW)
    return base_of_world(photo, kind, np.random.default_rng([seed, number]))


def base_of_world(photo: StoredView, kind: DepthKind, rng: Rng) -> BasePrediction:
    """The Gaussians of a world's photo, lifted by a depth of this kind.

    Args:
        photo: view 0 without a camera's noise: then its colours are those of the second views.
        kind: which depth.
        rng: draws the errors of outlines.

    Raises:
        InputError: the photo shows nothing but sky.
        ValueError: the guess takes near for far.
    """
    rgb = as_colors(photo.rgb)
    depth = with_far_sky(photo.depth)
    if kind == "guess":
        depth_map = guessed_depth(rgb, torch.from_numpy(1 / depth), _lite())
        # The map has fewer pixels than the photo. Near surfaces grow by the width of a pixel of the
        # map, in the photo's pixels, because an outline may lie anywhere in it (`LiteBase`, too).
        map_pixel_px = max(rgb.shape[:2]) / max(depth_map.depth.shape)
        growth = max(MIN_OUTLINE_GROWTH_PX, round(map_pixel_px))
        return lift_rgbd(rgb, depth_map, photo.camera, outline_growth_px=growth)
    if kind == "outlines":
        depth = with_wrong_outlines(depth, rng)
    return lift_rgbd(rgb, as_depth_map(torch.from_numpy(depth)), photo.camera)


@functools.cache
def _lite() -> LiteBase:
    """The package's base `lite`, which guesses depth from a photo; read once."""
    return LiteBase.load(device="cpu")


def as_colors(rgb: NDArray[np.uint8]) -> Tensor:
    """Colours [H, W, 3] in 0..1 of bytes [H, W, 3]."""
    return torch.from_numpy(rgb).float() / 255


def as_depth_map(depth: Tensor) -> DepthMap:
    """A depth map of depths [H, W] in metres, which are known at all pixels."""
    known = torch.ones_like(depth, dtype=torch.bool)
    return DepthMap(depth, known, None, None, "depth", Path("a world"))


def with_far_sky(depth: Floats) -> Floats:
    """Depth [H, W] in metres with the sky, where it was 0, put behind all surfaces.

    Raises:
        InputError: there is nothing but sky.
    """
    if not (depth > 0).any():
        raise InputError("a world whose photo shows nothing but sky")
    return np.where(depth > 0, depth, SKY_RATIO * depth.max()).astype(np.float32)


def with_wrong_outlines(depth: Floats, rng: Rng) -> Floats:
    """Depth [H, W] in metres whose outlines lie up to 5 pixels beside those of `depth`.

    Each pixel gets the depth of a pixel nearby. Offsets are random, and alike among neighbours.

    Args:
        depth: [H, W] metres, with outlines as in the photo.
        rng: draws how wide errors are, and the offsets.
    """
    height, width = depth.shape
    low, high = ERROR_WIDTHS_PX
    error_width_px = float(low * (high / low) ** rng.random())
    noise = torch.from_numpy(rng.standard_normal((height, width, 2)).astype(np.float32))
    smooth = gaussian_blur(noise[None], error_width_px)[0]  # [H, W, 2] offsets in rows and columns
    offsets = OUTLINE_ERROR_PX * (smooth / smooth.std()).numpy()
    offsets = offsets.clip(-MAX_OUTLINE_ERROR_PX, MAX_OUTLINE_ERROR_PX).round().astype(int)
    row, column = np.mgrid[:height, :width]
    row = (row + offsets[..., 0]).clip(0, height - 1)
    column = (column + offsets[..., 1]).clip(0, width - 1)
    moved: Floats = depth[row, column]
    return moved


def guessed_depth(rgb: Tensor, inverse_depth: Tensor, lite: LiteBase) -> DepthMap:
    """The depth map [h, w] in metres that `lite` guesses, scaled and shifted to the true depth.

    The guess g of inverse depth is true up to a factor s and a shift t. They are chosen so that
    s g + t has the least sum of absolute differences from the true inverse depth: then a few wrong
    surfaces do not move the others.

    Args:
        rgb: [H, W, 3] the photo.
        inverse_depth: [H, W] 1/m, the true one.
        lite: makes the guess.

    Raises:
        ValueError: the guess takes near for far.
    """
    guess = lite.inverse_depth(rgb)  # [h, w], smaller than the photo
    height, width = inverse_depth.shape
    resized = interpolate(guess[None, None], (height, width), mode="bilinear")[0, 0]
    scale, shift = line_of_least_differences(resized.flatten(), inverse_depth.flatten())
    if scale <= 0:
        raise ValueError("lite takes near for far")
    fitted = scale * guess + shift
    # The shift may make the inverse depth of far surfaces negative. So depths are limited to
    # MAX_DEPTH_RATIO times the nearest one, the limit that `lite` itself has.
    return as_depth_map(1 / fitted.clamp_min(float(fitted.max()) / MAX_DEPTH_RATIO))


def line_of_least_differences(x: Tensor, y: Tensor) -> tuple[float, float]:
    """s and t for which the sum of |s x + t - y| is least, for x and y [N].

    Least squares are solved again and again. Each time a pair is weighted by the inverse of the
    difference that the line before left, which makes a square of differences a plain difference.
    """
    points = torch.stack([x, torch.ones_like(x)], -1).double()  # [N, 2]
    values = y.double()
    weights = torch.ones_like(values)
    # Differences below this count alike, because their inverse would have no limit; 1e-12 is for
    # values that are all equal.
    floor = 1e-3 * float(values.std()) + 1e-12
    line = torch.zeros(2, dtype=torch.float64)
    for _ in range(FIT_ROUNDS):
        weighted = points * weights[:, None]
        line = torch.linalg.solve(weighted.T @ points, weighted.T @ values)
        weights = 1 / (points @ line - values).abs().clamp_min(floor)
    return float(line[0]), float(line[1])
