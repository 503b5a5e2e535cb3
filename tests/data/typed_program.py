"""A program of somebody who uses the wheel; type checkers find what is wrong in the last function,
and nothing else.
"""

from __future__ import annotations

import io
import threading
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import spackle
from spackle.web import create_app


class Own:
    """A base of one's own."""

    name = "own"

    def predict(self, photo: spackle.Photo, progress: object = None) -> spackle.BasePrediction:
        return spackle.LiteBase.load().predict(photo)


def main(photo: Path) -> None:
    scene: spackle.Scene = spackle.predict(photo, fov=60, trajectory="swipe", progress=True)
    session = spackle.Spackle(Own(), residual="initial", fill="exemplar", device="cpu")
    other: spackle.Scene = session.predict(np.zeros((48, 64, 3), np.uint8), disparity=0.1)
    scene.save("scene.ply")
    scene.export(io.BytesIO(), "spz")
    data: bytes = other.to_bytes("glb")
    scene.save_video("video.mp4", "rotate", fps=24)
    cameras: list[spackle.Camera] = scene.path("swipe", frames=4)
    view: spackle.Rendering = scene.render(cameras[0])
    depth: Tensor = scene.depth_map()
    share: float = spackle.hole_area_ratio(view.alpha)
    prediction = spackle.LiteBase.load().predict(spackle.load_photo(photo))
    completed = spackle.complete(
        prediction, cameras, exact=True, progress=lambda done, total: print(done, total)
    )
    stop = threading.Event()
    try:
        ended = spackle.predict(
            photo, progress=lambda update: print(update.stage, update.share), cancel=stop
        )
    except spackle.Cancelled:
        ended = spackle.predict(photo, cancel=lambda: stop.is_set())
    report: spackle.SceneReport | None = ended.report
    before: float | None = report.hole_ratio_before if report else None
    print(before)
    gaussians: spackle.Gaussians = completed.gaussians
    loaded = spackle.Scene.load("scene.ply", fov=60.0)
    spackle.save_ply(gaussians, "all.ply", camera=completed.camera, base_count=len(completed.base))
    near: Tensor = torch.where(gaussians.means[:, 2] > 1, 1.0, 0.0)
    app = create_app(Path("folder"))
    print(len(data), depth.shape, share, loaded.disparity, near.sum(), app.title)


def wrong() -> None:
    scene = spackle.predict("photo.jpg", trajectory="sideways")  # arg-type
    scene.export(3)  # arg-type
    spackle.Spackle(mode="paint")  # arg-type
    number: int = spackle.load_ply("a.ply")  # assignment
    print(number, spackle.predct("photo.jpg"))  # attr-defined
