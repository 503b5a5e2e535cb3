"""The hf base: a depth model of transformers looks at the photo, and its depth is lifted as a measured one is."""

from __future__ import annotations

import dataclasses
import math

from spackle.bases.device import own_arithmetic, pick_device
from spackle.bases.hf_input import crop
from spackle.bases.hf_kinds import scale_note, to_depth_map
from spackle.bases.hf_load import DepthModel, load_model, one_line
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.rgbd import lift
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.image import LENSES, Photo, resize_photo
from spackle.precision import Precision, pick_dtype

LENS_SOURCE = "Depth Pro"  # the only kind of model that gives a lens


class HfBase:
    """Any depth model that transformers runs and whose output has a known meaning (see `hf_kinds`), frozen."""

    def __init__(self, name: str, model: DepthModel, precision: str) -> None:
        """Use a model that is loaded already; `precision` is what the report says."""
        self.name = name
        self.model = model
        self.precision = precision

    @classmethod
    def load(cls, model: str, *, device: str | None = None, precision: Precision = "auto") -> HfBase:
        """Read a model's settings and weights.

        Args:
            model: a folder, or owner/name on the hub. What the hub's cache holds is taken from there, without
                network; the rest is copied into it.
            device: cpu or a CUDA device; where None, CUDA if it is there.
            precision: of the products of matrices; auto is bf16 where the hardware multiplies it natively.

        Raises:
            InputError: a device, package, model or file that is not there, a model that is broken, that is not a depth
                model or whose output has no known meaning, or too little memory. Nothing in the files is executed.
            ValueError: an unknown precision.
        """
        target = pick_device(device)
        dtype = pick_dtype(precision, target)
        name = f"hf:{model}"
        return cls(name, load_model(model, name, target, dtype), "bf16" if dtype.itemsize == 2 else "fp32")

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `rgbd.lift` makes them.

        A model that sees the lens gives it where neither the photo's file nor a person does.

        Args:
            photo: at its full size; the model looks at it at its working size.
            progress: called when the depth is there, and when it is lifted.

        Raises:
            InputError: the model cannot work on this photo, or what it says is no depth; or too little memory.
        """
        photo = resize_photo(photo)
        device = next(self.model.network.parameters()).device
        with one_line(f"{photo.path}: {self.name}", "fails", "give another photo or model"), own_arithmetic(device):
            raw, fov, window = self.model(photo.rgb)
        camera, lens_source = photo.camera, ""
        if fov is not None and photo.focal_source.startswith("default"):
            camera, lens_source = self._camera(photo, fov), LENS_SOURCE
        focal = camera.focal[0] / photo.width
        depth = to_depth_map(crop(raw, window), self.model.meaning, focal, self.name, photo.path)
        if progress:
            progress(1, 2)
        prediction = lift(photo.rgb, depth, camera)
        if progress:
            progress(2, 2)
        notes = {**prediction.notes, "precision": self.precision, "depth_scale": scale_note(self.model.meaning)}
        if invalid := int((~depth.valid).sum()):
            notes["depth_invalid_pixels"] = invalid
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)

    def _camera(self, photo: Photo, fov: float) -> Camera:
        """The photo's camera with a horizontal field of view in degrees."""
        focal = 0.5 * photo.width / math.tan(math.radians(fov) / 2) if 0 < fov < 180 else math.nan
        shortest, longest = (lens * max(photo.width, photo.height) for lens in LENSES)
        if not shortest <= focal <= longest:
            raise InputError(
                f"{photo.path}: {self.name} sees a field of view of {fov:g}°, which no lens has: "
                "give the focal length with --focal-mm"
            )
        return Camera.from_focal(focal, photo.width, photo.height)
