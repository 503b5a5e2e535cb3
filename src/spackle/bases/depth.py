"""Bases that lift a photo by a depth map: the photo's own map, or one that a network predicted."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.photo import Photo, replace_border, resize_photo
from spackle.depth.depth_map import ASPECT_TOLERANCE, DepthMap
from spackle.lifting.lift import lift_depth_map
from spackle.lifting.quadtree import TILE_LEVELS
from spackle.runtime.progress import Progress


class RgbdBase:
    """Lifts a photo with the photo's depth map."""

    name = "rgbd"

    def __init__(self, depth: DepthMap, lens_source: str = "calibration") -> None:
        """Use a depth map; `lens_source` says who gave its intrinsics, "" if it was the user."""
        self.depth = depth
        self.lens_source = lens_source

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels, on the surfaces that the depth map gives.

        The photo is first resized to its working size (the long side is at most 1536 pixels). The
        focal length and principal point are the map's, if it has them, else the photo's. InputError
        if the map's aspect ratio is not that of the photo.
        """
        depth, camera = self._cropped_to(photo)
        resized = resize_photo(photo)
        # A measured map's calibration is more exact than the focal length in the photo's file.
        if camera is None:
            camera = resized.camera
            lens_source = ""  # the report then names the source of the photo's focal length
        else:
            camera = camera.resized(resized.width, resized.height)
            lens_source = self.lens_source

        # The depth is lifted as it is: lifting resamples a map of any size to the photo's pixels.
        prediction = lift_rgbd(resized.rgb, depth, camera)
        notes = prediction.notes | {"depth_range": self.depth.range_in_words}
        if depth.note:
            notes["depth"] = depth.note
        if depth.meaning:
            notes["depth_read_as"] = depth.meaning
            notes["depth_unit"] = "guessed" if depth.is_guess else "given"
        framed_width, framed_height = photo.framed_size
        stretch = self.depth.stretch_to(framed_height, framed_width)
        if abs(stretch) > ASPECT_TOLERANCE:
            notes["depth_stretched"] = round(abs(stretch), 4)
        # A scene whose unit was only guessed does not count as metric.
        return dataclasses.replace(
            prediction, notes=notes, lens_source=lens_source, is_metric=not depth.is_guess
        )

    def _cropped_to(self, photo: Photo) -> tuple[DepthMap, Camera | None]:
        """The map and its camera, without the border that was cropped from the photo.

        The camera is None if the map has no intrinsics. InputError if the map's aspect ratio is not
        that of the photo with its border.
        """
        depth = self.depth
        # The map was made for the photo as it was before a uniform border was cropped.
        framed_width, framed_height = photo.framed_size
        depth.check_aspect_ratio(framed_height, framed_width, photo.path)
        rows, columns = depth.depth.shape
        camera = None
        if depth.K is not None:
            camera = Camera(depth.K, torch.eye(4), columns, rows)  # at the world's origin
        if photo.frame is None:  # no border was cropped
            return depth, camera

        # The same border is cropped from the map.
        frame = photo.frame
        depth = dataclasses.replace(
            depth,
            depth=frame.inside(depth.depth, framed_width, framed_height),
            valid=frame.inside(depth.valid, framed_width, framed_height),
        )
        # Cropping moves the principal point. The border's widths are in pixels of the photo: the
        # camera is first scaled to them.
        if camera is not None:
            camera = camera.resized(framed_width, framed_height)
            camera = camera.cropped(frame.left, frame.top, photo.width, photo.height)
        return depth, camera


def lift_predicted_depth(
    photo: Photo, depth: DepthMap, camera: Camera, *, outline_growth_px: int = 0
) -> BasePrediction:
    """Lift a photo with the depth that a network predicts, as `lift_rgbd` does.

    First the photo's outermost pixels are replaced by the pixels just inside, because they often
    show a scan's edge or colours mixed by resizing. If the network misses outlines by some pixels,
    near surfaces should grow by `outline_growth_px`.
    """
    prediction = lift_rgbd(
        replace_border(photo.rgb), depth, camera, outline_growth_px=outline_growth_px
    )
    # The Gaussians lack the border, but the photo itself is kept as it is.
    return dataclasses.replace(prediction, photo=photo.rgb)


def lift_rgbd(
    rgb: Tensor,
    depth: DepthMap,
    camera: Camera,
    levels: int = TILE_LEVELS,
    *,
    outline_growth_px: int = 0,
) -> BasePrediction:
    """Turn a photo [H, W, 3] (sRGB in 0..1) and its depth map into Gaussians on the surfaces.

    `camera` is the photo's camera. In flat areas, up to 2^levels × 2^levels pixels share a
    Gaussian; with `levels` = 0, each pixel has its own. At depth steps near surfaces grow by
    `outline_growth_px` pixels, for a map whose outlines are guessed. InputError if no pixel has a
    depth.
    """
    lifted = lift_depth_map(rgb, depth, camera, levels, outline_growth_px=outline_growth_px)
    return BasePrediction(lifted.gaussians, lifted.camera, lifted.notes, photo=rgb)
