"""A base without network, and small replacements for published weights."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from helpers.command import Run, run
from helpers.photos import box
from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.bases.lite import LiteNet
from spackle.core.photo import Photo, resize_photo
from spackle.depth.depth_map import DepthMap
from spackle.runtime.progress import Progress
from spackle.weights import PUBLISHED_WEIGHTS, PublishedWeights

SHARP_FILE = PUBLISHED_WEIGHTS["sharp"].file
QUICK = ("--no-render", "--residual", "none")


class StandIn:
    """A base that knows the depth of `photos.picture`."""

    def __init__(self, name: str) -> None:
        self.name = name

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        photo = resize_photo(photo)
        depth = torch.from_numpy(
            np.where(box(photo.width, photo.height), 2.0, 6.0).astype(np.float32)
        )
        map_ = DepthMap(depth, depth > 0, None, None, "depth", photo.path)
        return lift_rgbd(photo.rgb, map_, photo.camera)


def write_lite(path: Path) -> Path:
    torch.manual_seed(0)
    save_file(LiteNet().state_dict(), path)
    return path


def publish(
    patch: pytest.MonkeyPatch, name: str, content: bytes, **changes: object
) -> PublishedWeights:
    """Replace the published weights of that name by other bytes until the test ends."""
    facts = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest(), **changes}
    patch.setitem(PUBLISHED_WEIGHTS, name, dataclasses.replace(PUBLISHED_WEIGHTS[name], **facts))  # type: ignore[arg-type]
    return PUBLISHED_WEIGHTS[name]


def write_model(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name, text in (
        ("config.json", "{}"),
        ("model.safetensors", "weights"),
        ("README.md", "about it"),
    ):
        (folder / name).write_text(text)
    return folder


def predict(tmp_path: Path, *options: object) -> Run:
    return run("predict", "-o", tmp_path / "out", *QUICK, *options)
