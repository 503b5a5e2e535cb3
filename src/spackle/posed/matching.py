"""Depths of patches that several photos show, where no points of a reconstruction are known."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from spackle.core.camera import Camera
from spackle.posed.correction import KnownDepths

WORKING_WIDTH_PX = 480  # photos are matched at this width: finer pixels tell little more depth
CELL_PX = 14  # the most distinct patch of each cell is matched
PATCH_RADIUS_PX = 4  # patches of 9×9 pixels
NEIGHBOURS = 3  # photos that are searched for the patch
# They are the nearest ones, but not much nearer than the last of these candidates: from almost the
# same place, every depth looks alike.
CANDIDATES = 6
MIN_DISTANCE_RATIO = 0.25
STEPS = 64  # inverse depths that are tried
MAX_SHIFT = 0.35  # of the picture's width: the nearest thing moves by at most this to a neighbour
MIN_CONTRAST = 0.02  # standard deviation of a patch's grey; less shows nothing to match
MIN_SIMILARITY = 0.85  # normalised cross-correlation of the best match
MIN_LEAD = 0.05  # by which the best match must be better than any match elsewhere
ELSEWHERE_STEPS = 3  # steps away that count as elsewhere


def match_depths(
    pictures: Sequence[Tensor], cameras: Sequence[Camera], index: int, target: Camera
) -> KnownDepths:
    """Depths of patches of a photo that its neighbours show at one depth, and at no other.

    For each patch, many depths are tried: at the right one, the patch looks the same in the
    neighbouring photos (normalised cross-correlation, the mean of the two best neighbours).

    Args:
        pictures: [H, W, 3] sRGB of all photos.
        cameras: of the photos, in the world, at the size that their file states.
        index: of the photo in these lists.
        target: the photo's camera in whose pixels the result is.
    """
    neighbours = _nearest(cameras, index)
    gray, camera = _at_working_size(pictures[index], cameras[index])
    uv = _distinct_places(gray)  # [N, 2]
    if not len(uv) or not neighbours:
        return KnownDepths(torch.zeros(0, 2), torch.zeros(0))

    # A point of inverse depth q moves by focal · baseline · q pixels to another photo, whose eye
    # is a baseline away. So equal steps of q, from infinity to the nearest thing, are equal
    # movements; the nearest thing moves by MAX_SHIFT in the neighbour that is farthest away.
    baselines = [float((cameras[n].position - cameras[index].position).norm()) for n in neighbours]
    nearest_inverse = MAX_SHIFT * camera.width / (camera.focal[0] * max(baselines))
    inverse_depths = nearest_inverse * (torch.arange(STEPS) + 0.5) / STEPS  # [S]

    # A neighbour from which a patch is hidden must not spoil it, so the two best ones decide.
    scores = []
    for neighbour in neighbours:
        other_gray, other_camera = _at_working_size(pictures[neighbour], cameras[neighbour])
        scores.append(_similarities(gray, camera, other_gray, other_camera, uv, inverse_depths))
    all_scores = torch.stack(scores)  # [neighbours, N, S]
    best_of_neighbours = all_scores.topk(min(2, len(scores)), dim=0).values.mean(0)  # [N, S]
    is_clear, inverse = _clear_maxima(best_of_neighbours, inverse_depths)

    to_target = torch.tensor([target.width / camera.width, target.height / camera.height])
    return KnownDepths(uv[is_clear] * to_target, 1 / inverse[is_clear])


def _nearest(cameras: Sequence[Camera], index: int) -> list[int]:
    """Some near cameras that stand elsewhere and look into about the same direction."""
    own = cameras[index]
    candidates = []
    for other, camera in enumerate(cameras):
        distance = float((camera.position - own.position).norm())
        # Row 2 of the rotation is the direction in which a camera looks, so this is the cosine of
        # the angle between the two.
        agreement = float(camera.world_to_camera[2, :3] @ own.world_to_camera[2, :3])
        if other != index and distance > 0 and agreement > 0.5:  # up to 60 degrees apart
            candidates.append((distance, other))
    nearest = sorted(candidates)[:CANDIDATES]
    if not nearest:
        return []
    least = MIN_DISTANCE_RATIO * nearest[-1][0]
    return [other for distance, other in nearest if distance >= least][:NEIGHBOURS]


def _at_working_size(rgb: Tensor, camera: Camera) -> tuple[Tensor, Camera]:
    """A photo's grey [h, w] float32 and its camera (float32) at the size for matching."""
    width = min(WORKING_WIDTH_PX, rgb.shape[1])
    height = max(1, round(rgb.shape[0] * width / rgb.shape[1]))
    gray = rgb.float().mean(2)[None, None]
    small = interpolate(gray, size=(height, width), mode="bilinear", antialias=True)[0, 0]
    return small, camera.resized(width, height).to(dtype=torch.float32)


def _distinct_places(gray: Tensor) -> Tensor:
    """[N, 2] the pixel with most contrast around it in each cell of a picture [h, w]."""
    down, right = torch.gradient(gray)
    strength = down.square() + right.square()
    margin = PATCH_RADIUS_PX + 1
    inner = strength[margin:-margin, margin:-margin]
    rows = inner.shape[0] // CELL_PX
    columns = inner.shape[1] // CELL_PX
    if rows < 1 or columns < 1:
        return torch.zeros(0, 2)
    cells = inner[: rows * CELL_PX, : columns * CELL_PX]
    cells = cells.reshape(rows, CELL_PX, columns, CELL_PX).transpose(1, 2).flatten(2)
    strongest = cells.argmax(2)  # [rows, columns], the place within the cell
    y = torch.arange(rows)[:, None] * CELL_PX + strongest // CELL_PX + margin
    x = torch.arange(columns)[None, :] * CELL_PX + strongest % CELL_PX + margin
    uv = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    contrast = _patches(gray, uv).std(1)
    return uv[contrast >= MIN_CONTRAST]


def _offsets() -> Tensor:
    """[P, 2] the pixels of a patch, relative to its middle."""
    side = torch.arange(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1).float()
    return torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)


def _patches(gray: Tensor, uv: Tensor) -> Tensor:
    """[N, P] the grey of patches around pixel positions [N, 2]; beyond the picture its border."""
    return _sample(gray, uv[:, None, :] + _offsets())


def _sample(gray: Tensor, uv: Tensor) -> Tensor:
    """The grey [N, P] of a picture [h, w] at pixel positions [N, P, 2], linear between pixels."""
    size = torch.tensor([gray.shape[1], gray.shape[0]])
    grid = (2 * uv / size - 1)[None]  # pixel centres lie at half-integers
    return grid_sample(gray[None, None], grid, padding_mode="border", align_corners=False)[0, 0]


def _similarities(
    gray: Tensor,
    camera: Camera,
    other_gray: Tensor,
    other_camera: Camera,
    uv: Tensor,
    inverse_depths: Tensor,
) -> Tensor:
    """[N, S] how alike patches look in another photo if they are at each of S inverse depths.

    The patch is taken as a plane that faces the camera. -1 where its middle is not in the other
    photo.
    """
    own = _normalised(_patches(gray, uv))  # [N, P]
    places = uv[:, None, :] + _offsets()  # [N, P, 2]
    size = torch.tensor([other_camera.width, other_camera.height])
    middle = len(_offsets()) // 2
    columns = []
    for inverse in inverse_depths:
        points = camera.unproject(places, torch.full(places.shape[:2], float(1 / inverse)))
        other_uv, z = other_camera.project(points)
        inside = ((other_uv[:, middle] >= 0) & (other_uv[:, middle] < size)).all(1)
        inside &= z[:, middle] > 0
        similarity = (own * _normalised(_sample(other_gray, other_uv))).mean(1)
        columns.append(similarity.where(inside, -1.0))
    return torch.stack(columns, dim=1)


def _normalised(patches: Tensor) -> Tensor:
    """Patches [N, P] with mean 0 and standard deviation 1, so that exposure does not count."""
    centred = patches - patches.mean(1, keepdim=True)
    return centred / centred.std(1, correction=0, keepdim=True).clamp(min=MIN_CONTRAST / 2)


def _clear_maxima(scores: Tensor, inverse_depths: Tensor) -> tuple[Tensor, Tensor]:
    """Which of N patches have one clear depth, [N] bool, and their inverse depth [N].

    `scores` [N, S] are the similarities at the inverse depths [S], which are equally spaced.
    """
    best, step = scores.max(1)
    steps = torch.arange(scores.shape[1])
    is_elsewhere = (steps[None, :] - step[:, None]).abs() >= ELSEWHERE_STEPS
    best_elsewhere = scores.where(is_elsewhere, -1.0).max(1).values
    is_inner = (step > 0) & (step < scores.shape[1] - 1)
    is_clear = (best >= MIN_SIMILARITY) & (best - best_elsewhere >= MIN_LEAD) & is_inner

    # A parabola through the maximum and its two neighbours gives a part of a step.
    inner = step.clamp(1, scores.shape[1] - 2)
    rows = torch.arange(len(scores))
    before = scores[rows, inner - 1]
    after = scores[rows, inner + 1]
    bend = before - 2 * scores[rows, inner] + after
    shift = (0.5 * (before - after) / bend).where(bend < 0, 0.0).clamp(-0.5, 0.5)
    spacing = inverse_depths[1] - inverse_depths[0]
    return is_clear, inverse_depths[inner] + shift * spacing
