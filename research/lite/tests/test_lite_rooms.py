"""Made rooms as training data of the lite base."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from made_rooms import Rooms, of_rooms
from mixture import Mixture
from PIL import Image
from recipe import LiteData, LiteFiles

from spackle.paper.dataset.encoding import encode_depth, encode_png
from spackle.paper.dataset.sample import END_OF_ARCHIVE, tar_member
from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it


def jpeg(value: int) -> bytes:
    """A grey JPEG of 32×24 pixels."""
    stream = io.BytesIO()
    Image.new("RGB", (32, 24), (value,) * 3).save(stream, "JPEG", quality=95)
    return stream.getvalue()


def write_rooms(path: Path) -> None:
    """Write an archive of one room with two views: a wall at 2 m with sky above it and a pane."""
    depth = torch.full((24, 32), 2.0)
    depth[:8] = torch.inf
    valid = np.ones((24, 32), np.uint8)
    valid[:8] = 2
    valid[20:] = 0
    depth[:, 16:] = torch.where(depth[:, 16:] < 3, 4.0, torch.inf)
    png, depth_range = encode_depth(depth, torch.isfinite(depth))
    views = [{"depth_range": list(depth_range)}] * 2
    files = {"a.json": json.dumps({"views": views}).encode(), "a.photo.jpg": jpeg(200)}
    for number in range(2):
        files[f"a.{number:02d}.rgb.jpg"] = jpeg(100)
        files[f"a.{number:02d}.depth.png"] = png
        files[f"a.{number:02d}.valid.png"] = encode_png(valid)
    members = [tar_member(name, content) for name, content in files.items()]
    path.write_bytes(b"".join(members) + END_OF_ARCHIVE)


def test_a_view_has_inverse_depth_an_infinitely_far_sky_and_unknown_panes(tmp_path: Path) -> None:
    write_rooms(tmp_path / "worlds-00000.tar")
    photo, second = of_rooms(tmp_path)
    frame = photo.read()
    assert float(frame.rgb.mean()) == pytest.approx(200 / 255, abs=0.01)
    assert float(second.read().rgb.mean()) == pytest.approx(100 / 255, abs=0.01)
    assert frame.inverse_depth[10, 2] == pytest.approx(0.5, abs=1e-4)
    assert frame.inverse_depth[10, 20] == pytest.approx(0.25, abs=1e-4)
    assert frame.inverse_depth[0, 0] == 0
    assert bool(frame.valid[0, 0])
    assert not bool(frame.valid[22].any())


def test_rooms_are_drawn_into_batches(tmp_path: Path) -> None:
    write_rooms(tmp_path / "worlds-00000.tar")
    mixture = Mixture([Rooms(of_rooms(tmp_path))], [1.0], (64, 96), 0)
    batch = mixture.batch(0, [0, 1])
    assert bool(batch.valid.any())
    assert torch.equal(batch.rgb, mixture.batch(0, [0, 1]).rgb)
    assert "worlds-00000.tar a.0" in mixture.name(0, 0)


def test_damaged_or_missing_archives_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"data\.worlds"):
        of_rooms(tmp_path)
    (tmp_path / "worlds-00000.tar").write_bytes(b"no archive")
    with pytest.raises(InputError, match="worlds-00000"):
        of_rooms(tmp_path)


def test_a_share_of_0_leaves_rooms_out_and_the_rooms_are_part_of_the_digest(
    tmp_path: Path,
) -> None:
    from lite_data import write_data
    from recipe import LiteShares

    write_data(tmp_path)
    (tmp_path / "rooms").mkdir()
    write_rooms(tmp_path / "rooms" / "worlds-00000.tar")
    data = LiteData(
        stereo=tmp_path / "pairs",
        validation_stereo=tmp_path / "others",
        worlds=tmp_path / "rooms",
    )
    files = LiteFiles.of(data)
    assert len(files.worlds) == 2
    without = LiteFiles.of(data.model_copy(update={"shares": LiteShares(worlds=0)}))
    assert without.worlds == ()
    write_rooms(tmp_path / "rooms" / "worlds-00001.tar")
    assert LiteFiles.of(data).digest != files.digest


def test_rooms_for_validation_are_a_group_without_sky_and_none_that_is_trained_on(
    tmp_path: Path,
) -> None:
    for folder in ("learned", "held"):
        (tmp_path / folder).mkdir()
        write_rooms(tmp_path / folder / f"worlds-{folder}.tar")
    data = LiteData(worlds=tmp_path / "learned", validation_worlds=tmp_path / "held")
    (group,) = LiteFiles.of(data).groups
    assert group.name == "rooms"
    (photo,) = group.files
    valid = photo.read(768).valid
    assert bool(valid[10, 2])
    assert not bool(valid[0, 0])  # sky

    with pytest.raises(InputError, match=r"validation_worlds has rooms of data\.worlds"):
        LiteFiles.of(data.model_copy(update={"validation_worlds": tmp_path / "learned"}))


def test_streets_are_read_with_rooms_and_tracks_are_not(tmp_path: Path) -> None:
    for name in ("worlds-00000.tar", "streets-00000.tar", "tracks-00000.tar"):
        write_rooms(tmp_path / name)
    archives = {view.archive.name for view in of_rooms(tmp_path)}
    assert archives == {"worlds-00000.tar", "streets-00000.tar"}
