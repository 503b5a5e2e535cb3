"""Folders of photos with known cameras: which photo belongs to which camera, and their points."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.posed_captures import (
    EYES,
    HEIGHT,
    WIDTH,
    view,
    write_colmap,
    write_nerfstudio,
    write_record3d,
)
from PIL import Image

from spackle.posed import capture as capture_module
from spackle.posed.capture import read_capture
from spackle.runtime.errors import InputError


def true_errors(folder: Path) -> list[torch.Tensor]:
    """Relative errors of the depths of the points that each photo sees."""
    capture = read_capture(folder)
    assert capture.points is not None
    errors = []
    for file, eye in zip(capture.photos, EYES, strict=True):
        seen = capture.points.seen_by(file.camera, file.name)
        column, row = seen.uv.long().unbind(1)
        errors.append((seen.z / view(eye).depth[row, column] - 1).abs())
    return errors


def test_colmaps_points_lie_where_the_photos_see_them(tmp_path: Path) -> None:
    for errors in true_errors(write_colmap(tmp_path / "room")):
        assert len(errors) > 50
        assert float(errors.max()) < 0.02


def test_of_points_without_notes_those_that_are_hidden_are_mostly_left_out(tmp_path: Path) -> None:
    for errors in true_errors(write_nerfstudio(tmp_path / "nerf")):
        assert len(errors) > 50
        assert float((errors < 0.05).double().mean()) > 0.9


def test_photos_of_another_size_and_suffix_belong_to_their_cameras(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "room")
    for file in sorted((folder / "images").iterdir()):
        with Image.open(file) as image:
            image.resize((WIDTH // 2, HEIGHT // 2)).save(file.with_suffix(".jpg"))
        file.unlink()
    capture = read_capture(folder)
    assert [photo.path.name for photo in capture.photos] == ["0.jpg", "1.jpg", "2.jpg"]
    photo = capture.photos[0].load()
    assert photo.focal_px == pytest.approx(capture.photos[0].camera.focal[0] / 2)


def test_depth_maps_beside_the_photos_are_found(tmp_path: Path) -> None:
    capture = read_capture(write_record3d(tmp_path / "phone"))
    depths = [photo.depth for photo in capture.photos]
    assert [path.name for path in depths if path is not None] == ["0.npy", "1.npy", "2.npy"]
    assert capture.is_metric
    assert capture.points is None


def test_too_many_photos_are_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture_module, "MAX_PHOTOS", 2)
    with pytest.raises(InputError, match=r"3 photos with cameras.*delete all but 2"):
        read_capture(write_colmap(tmp_path / "room"))
