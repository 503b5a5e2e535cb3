"""Keep what a base made of each photo until the scene is complete, so that a killed run goes on."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import torch
from safetensors import SafetensorError

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import make_folder
from spackle.runtime.tensor_digests import read_signed_tensors, signed_tensors

FIELDS = ("means", "quats", "scales", "opacities", "colors")


@dataclasses.dataclass(frozen=True)
class KeptPredictions:
    """A folder with a file for each photo that was predicted."""

    folder: Path

    def load(self, key: str) -> tuple[BasePrediction, str] | None:
        """The prediction that was kept under a key, and the base's name; None if there is none."""
        path = self.folder / f"{key}.safetensors"
        # A damaged file is no error: the photo is simply predicted again.
        try:
            tensors = read_signed_tensors(path)
            facts = json.loads(tensors["facts"])
            camera = Camera(tensors["K"], torch.eye(4), facts["width"], facts["height"])
            prediction = BasePrediction(
                Gaussians(*(tensors[name] for name in FIELDS)),
                camera,
                notes={},
                max_disparity=facts["max_disparity"],
                is_metric=facts["is_metric"],
            )
        except (OSError, SafetensorError, KeyError, TypeError, ValueError):
            return None
        return prediction, str(facts["base"])

    def save(self, key: str, prediction: BasePrediction, base_name: str) -> None:
        """Keep a prediction under a key, whole or not at all.

        Raises:
            InputError: the folder cannot be written.
        """
        make_folder(self.folder)
        gaussians = prediction.gaussians.to("cpu")
        tensors = {name: getattr(gaussians, name).contiguous() for name in FIELDS}
        tensors["K"] = prediction.camera.K.cpu().contiguous()
        facts = {
            "width": prediction.camera.width,
            "height": prediction.camera.height,
            "max_disparity": prediction.max_disparity,
            "is_metric": prediction.is_metric,
            "base": base_name,
        }
        content = signed_tensors(tensors, {"facts": json.dumps(facts)})
        write_atomic(self.folder / f"{key}.safetensors", content)

    def remove(self) -> None:
        """Delete the folder, once the scene is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)
