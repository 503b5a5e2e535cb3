"""From a dataset's cameras to cameras in a base's scene.

A base, the network that turns a photo into Gaussians, guesses unit of length and focal length. To
render the viewpoint of a second photo, the dataset's camera is converted: `align` finds the ratio
of the units, `camera_in_base_scene` the camera.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation.case import Case, Points
from spackle.runtime.errors import InputError

MIN_ALIGNED_PIXELS = 8  # the least number of pixels whose depth ratios are trusted
# LLFF's near and far bounds are these quantiles of the depths of points.
DEPTH_BOUND_QUANTILES = (0.001, 0.999)


def align(case: Case, base_depth: Tensor, is_covered: Tensor) -> float:
    """The ratio of the units of length, dataset depth / base depth.

    It is the median over the pixels whose depth is known in both. The dataset's depth comes from
    its depth map, or else from points, or else from the bounds of the depth. A metric base and a
    metric dataset are aligned too, because a network's metres are rarely exact.

    Args:
        case: the photo with its known depth, in the dataset's unit.
        base_depth: [H, W] the base's depth at the photo's camera, in the base's unit, at any size
            with the photo's aspect ratio.
        is_covered: [H, W] bool, the pixels with a valid depth of the base.

    Raises:
        InputError: too few pixels have known depth in both.
    """
    is_covered = is_covered & torch.isfinite(base_depth) & (base_depth > 0)

    candidates = []
    if case.read_depth is not None:
        candidates.append(_ratios_of_depth_map(case.read_depth(), base_depth, is_covered))
    if case.read_points is not None:
        assert case.camera is not None  # points are in pixels of this camera
        points = case.read_points()
        candidates.append(_ratios_of_points(points, case.camera, base_depth, is_covered))

    # The first source with enough pixels decides. A median, because some depths are wrong.
    for ratios in candidates:
        ratios = ratios[torch.isfinite(ratios) & (ratios > 0)].double()
        if len(ratios) >= MIN_ALIGNED_PIXELS:
            return float(ratios.median())

    if case.depth_bounds is not None and is_covered.any():
        return _ratio_of_bounds(case.depth_bounds, base_depth[is_covered])
    raise InputError(
        f"{case.name}: the base's scale cannot be found: the dataset's depth is unknown, or the "
        f"dataset's and the base's depth share under {MIN_ALIGNED_PIXELS} pixels: "
        "take the protocol large-view"
    )


def _ratio_of_bounds(depth_bounds: tuple[float, float], base_depth: Tensor) -> float:
    """The ratio of the units of length, from the nearest and farthest depth of a scene.

    Args:
        depth_bounds: nearest and farthest depth, in the dataset's unit.
        base_depth: [N] depths of the base, in the base's unit.

    Returns:
        The geometric mean of the ratio at the nearest and the ratio at the farthest depth.
    """
    # The bounds are quantiles of the depth of a scene's points, near 0 and near 1. They are
    # compared with the same quantiles of the base's depth.
    ascending = base_depth.double().sort().values
    ratios = []
    for bound, quantile in zip(depth_bounds, DEPTH_BOUND_QUANTILES, strict=True):
        index = round(quantile * (len(ascending) - 1))
        ratios.append(bound / float(ascending[index]))
    return math.sqrt(math.prod(ratios))


def _ratios_of_depth_map(known: DepthMap, base_depth: Tensor, is_covered: Tensor) -> Tensor:
    """Ratios of a dataset's depth map to the base's depth, [N], for pixels where both are known.

    Each pixel of the base is compared with the nearest pixel of the depth map; the two may have
    different sizes. `base_depth` is [H, W], `is_covered` [H, W] bool tells where it is valid.
    """
    height, width = base_depth.shape
    map_height, map_width = known.depth.shape

    # The pixel of the map that contains the centre of each pixel of the base.
    row = ((torch.arange(height) + 0.5) * map_height / height).long()
    column = ((torch.arange(width) + 0.5) * map_width / width).long()
    known_depth = known.depth[row][:, column]  # [H, W]
    is_known = known.valid[row][:, column] & is_covered

    return known_depth[is_known] / base_depth[is_known]


def _ratios_of_points(
    points: Points, camera: Camera, base_depth: Tensor, is_covered: Tensor
) -> Tensor:
    """Ratios of points' depths to the base's depth, [N], for points in a pixel with depth.

    Args:
        points: points with depth in the dataset's unit.
        camera: the camera in whose pixels the points lie.
        base_depth: [H, W] the base's depth, at any size with the camera's aspect ratio.
        is_covered: [H, W] bool, where `base_depth` is valid.
    """
    height, width = base_depth.shape

    # The pixel of the base in which each point lies.
    base_pixels_per_camera_pixel = torch.tensor([width / camera.width, height / camera.height])
    pixel = (points.uv * base_pixels_per_camera_pixel).floor().long()  # [N, 2]
    is_in_image = ((pixel >= 0) & (pixel < torch.tensor([width, height]))).all(1)
    column, row = pixel[is_in_image].unbind(1)

    is_known = is_covered[row, column]
    return points.z[is_in_image][is_known] / base_depth[row, column][is_known]


def camera_in_base_scene(
    view: Camera, photo_camera: Camera, base_camera: Camera, scale: float
) -> Camera:
    """The camera that sees the base's scene as a second photo's camera sees the real one.

    The base and the dataset may assume different intrinsics for the input photo. Then a pixel with
    a depth is one point in the base's scene and another in the dataset's, and the base's scene is a
    sheared copy of the dataset's. The returned camera makes up for this: it projects a point of the
    base to the pixel to which `view` projects the dataset's point. This is exact if the two photos
    look in the same direction, as in rectified pairs, or if the intrinsics agree; otherwise it is
    exact up to a skew of the pixel grid.

    Let `view` have intrinsics K, rotation R and translation t, and let the input photo have
    intrinsics K0 in the dataset and Kb in the base. With s = `scale`:

    - the base's point x is the dataset's point s · K0⁻¹ Kb x;
    - `view` projects it by K (s · R K0⁻¹ Kb x + t);
    - so the result has intrinsics K' and rotation R' with K' R' = K R K0⁻¹ Kb, and translation
      K'⁻¹ K t / s.

    Args:
        view: the second photo's camera, in the input photo's frame and the dataset's unit.
        photo_camera: the dataset's camera of the input photo.
        base_camera: the base's camera of the input photo, at any size with the photo's aspect
            ratio.
        scale: dataset depth / base depth, from `align`.

    Returns:
        The camera, with the image size of `view`, in the base's frame and unit.
    """
    K = view.K.double()
    rotation = view.world_to_camera[:3, :3].double()
    translation = view.world_to_camera[:3, 3].double()

    base_K = base_camera.resized(photo_camera.width, photo_camera.height).K.double()
    shear = torch.linalg.solve(photo_camera.K.double(), base_K)  # K0⁻¹ Kb
    new_K, new_rotation = _intrinsics_times_rotation(K @ rotation @ shear)

    # The translation needs K' as it is; only then K' is scaled to have 1 in its last entry, which
    # changes no projected pixel.
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = new_rotation
    pose[:3, 3] = torch.linalg.solve(new_K, K @ translation) / scale

    new_K = new_K / new_K[2, 2]
    new_K[0, 1] = 0.0  # drop the skew, which a Camera cannot have
    return Camera(new_K.to(view.K), pose.to(view.world_to_camera), view.width, view.height)


def _intrinsics_times_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Split a matrix [3, 3] into intrinsics (upper triangular, diagonal > 0) times a rotation.

    This is an RQ decomposition, made from torch's QR decomposition: reversing rows and columns
    turns an upper triangular matrix into a lower triangular one, which transposed is upper again.
    """
    flip = torch.eye(3, dtype=torch.float64).flip(0)
    q, r = torch.linalg.qr((flip @ matrix).T)
    intrinsics = flip @ r.T @ flip
    rotation = flip @ q.T

    # QR may give negative numbers on the diagonal. If a column of the intrinsics and the same row
    # of the rotation change their signs, the product stays the same.
    signs = torch.diag(intrinsics.diagonal().sign())
    return intrinsics @ signs, signs @ rotation
