"""PLY: round trips, an independent reader, SHARP's variants, and hostile files."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.photos import read_ply
from helpers.scenes import random_gaussians, same_bits

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.formats import PlyFile, load_ply, save_ply
from spackle.formats.ply import ROWS_PER_BLOCK
from spackle.runtime.errors import InputError

PROPERTIES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
PROPERTIES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
GIVEN = [*PROPERTIES[:3], *PROPERTIES[6:]]  # SHARP writes no normals


def raw(gaussians: Gaussians) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The values of the properties GIVEN, [N, 14], in float64."""
    m, q, s, o, c = (t.double() for t in gaussians.tensors)
    sh = (linear_to_srgb(c) - 0.5) / 0.28209479177387814
    return np.asarray(torch.cat([m, sh, torch.logit(o)[:, None], s.log(), q], dim=1))


def ply(rows: Any, kind: str = "float") -> bytes:
    header = "ply\nformat binary_little_endian 1.0\ncomment made by a test\n"
    header += f"element vertex {len(rows)}\n"
    header += "".join(f"property {kind} {name}\n" for name in GIVEN) + "end_header\n"
    return header.encode() + rows.astype({"float": "<f4", "double": "<f8"}[kind]).tobytes()


PLY_DATA = DATA / "ply"  # `random_gaussians(3)` as SHARP and others write them


def close(a: Gaussians, b: Gaussians) -> None:
    for x, y in zip(a.tensors, b.tensors, strict=True):
        torch.testing.assert_close(x, y, rtol=2e-5, atol=2e-5)


def written(path: Path) -> np.ndarray[Any, np.dtype[np.float32]]:
    """The rows of a file, [N, 17], by an independent reader."""
    ply = read_ply(path)
    assert ply.names == PROPERTIES
    return np.frombuffer(ply.body, "<f4").reshape(ply.count, -1)


def test_independent_reader_finds_what_was_meant(tmp_path: Path) -> None:
    gaussians = random_gaussians(300)
    save_ply(gaussians, tmp_path / "a.ply")
    found = written(tmp_path / "a.ply")
    expected = raw(gaussians)
    expected[:, 10:] /= np.linalg.norm(expected[:, 10:], axis=1, keepdims=True)
    np.testing.assert_allclose(np.delete(found, [3, 4, 5], axis=1), expected, rtol=1e-5, atol=2e-5)
    assert not found[:, 3:6].any()
    strided = Gaussians(
        *(torch.stack([t, t], dim=-1).double().requires_grad_()[..., 0] for t in gaussians.tensors)
    )
    save_ply(strided, tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_extremes_stay_finite(tmp_path: Path) -> None:
    opacities = torch.tensor([0.0, 1.0, 0.999, 0.9999, 0.99999, 1e-6])
    scales = torch.tensor([0.0, 1e-30, 1e-3, 1.0, 1e30, torch.inf])[:, None].repeat(1, 3)
    colors = torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0, 1e-5])[:, None].repeat(1, 3)
    save_ply(
        Gaussians(torch.full((6, 3), 1e6), torch.zeros(6, 4), scales, opacities, colors),
        tmp_path / "a.ply",
    )
    assert np.isfinite(written(tmp_path / "a.ply")).all()
    found = load_ply(tmp_path / "a.ply")
    torch.testing.assert_close(found.opacities, opacities, rtol=2e-7, atol=1e-9)
    torch.testing.assert_close(found.colors, colors.clamp(0, 1), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.scales[1:-1], scales[1:-1], rtol=2e-5, atol=0)
    assert found.quats.tolist() == [[1, 0, 0, 0]] * 6
    assert 0 < found.scales.min() < 1e-30
    assert torch.isfinite(found.scales).all()


@pytest.mark.parametrize("count", [1, ROWS_PER_BLOCK, ROWS_PER_BLOCK + 777])
def test_first_rows_depend_on_the_first_gaussians_alone(tmp_path: Path, count: int) -> None:
    base = random_gaussians(count)
    more = random_gaussians(3 * ROWS_PER_BLOCK + 1, seed=1)
    save_ply(base, tmp_path / "base.ply")
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        save_ply(Gaussians.cat([base, more]), tmp_path / "both.ply")
    finally:
        torch.set_num_threads(threads)
    rows = [
        (tmp_path / name).read_bytes().split(b"end_header\n", 1)[1]
        for name in ("base.ply", "both.ply")
    ]
    assert rows[1].startswith(rows[0])
    loaded = load_ply(tmp_path / "base.ply")
    both = load_ply(tmp_path / "both.ply")
    close(
        loaded, dataclasses.replace(base, quats=torch.nn.functional.normalize(base.quats, dim=-1))
    )
    assert torch.equal(loaded.means, base.means)
    assert same_bits(loaded, both.select(slice(0, count)))


@pytest.mark.parametrize("path", sorted(PLY_DATA.glob("[bl]*.ply")), ids=lambda path: path.stem)
def test_orders_and_types(path: Path) -> None:
    found = load_ply(path)
    assert found.harmonics_count == 15
    close(found.with_harmonics_count(0), random_gaussians(3))
    assert PlyFile(path).camera() is None


def camera_of(path: Path) -> Camera:
    camera = PlyFile(path).camera()
    assert camera is not None
    return camera


@pytest.mark.parametrize("name", ["sharp, srgb.ply", "sharp, linear.ply"])
def test_sharp_file(name: str) -> None:
    close(load_ply(PLY_DATA / name), random_gaussians(3))
    camera = camera_of(PLY_DATA / name)
    assert (camera.width, camera.height, camera.focal) == (640, 480, (500, 500))
    assert torch.equal(camera.world_to_camera, torch.eye(4))


def test_what_a_comment_keeps(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    camera = Camera.from_focal(50.25, 64, 48)
    save_ply(random_gaussians(9), path)
    plain = PlyFile(path)
    assert plain.camera() is plain.base_count() is plain.disparity() is None
    save_ply(random_gaussians(9), path, camera=camera, base_count=7, disparity=0.3)
    file = PlyFile(path)
    found = camera_of(path)
    assert torch.equal(found.K, camera.K)
    assert (found.width, found.height, file.base_count(), file.disparity()) == (64, 48, 7, 0.3)
    content = path.read_bytes()
    for load, kept, wrong in (
        (PlyFile.base_count, "spackle_base 7", ("10", "-3", "x")),
        (PlyFile.disparity, "spackle_disparity 0.3", ("nan", "1 2")),
        (PlyFile.camera, "spackle_camera 50.25", ("0", "")),
    ):
        for value in wrong:
            path.write_bytes(content.replace(kept.encode(), f"{kept.split()[0]} {value}".encode()))
            with pytest.raises(InputError, match=r"a\.ply: the stored"):
                load(PlyFile(path))


GOOD = ply(raw(random_gaussians(3)))
LISTED = b"element face 1\nproperty list uchar int vertex_indices\n"


def spoiled(column: int, value: float, kind: str = "float") -> bytes:
    rows = raw(random_gaussians(3))
    rows[1:, column] = value
    return ply(rows, kind)


BAD: list[tuple[bytes, str]] = [
    (b"", "empty"),
    (b"hello\nthere\n", "not a PLY"),
    (GOOD[:-1], "cut off"),
    (b"ply\n" + b"comment x\n" * 100_000, "no end"),
    (GOOD.replace(b"vertex 3", b"vertex 1000000000000"), "but the file ends after"),
    (GOOD.replace(b"vertex 3", b"vertex 0"), "no Gaussians"),
    (GOOD.replace(b"vertex 3", b"vortex 3"), "0 elements"),
    (GOOD.replace(b"scale_1", b"scale_9"), "have no scale_1"),
    (GOOD.replace(b"property float opacity", b"property half opacity"), "broken PLY header"),
    (b"ply\nend_header\n", "no format line"),
    (GOOD.replace(b"end_header", b"property list uchar int i\nend_header"), "lists in"),
    (GOOD.replace(b"element", LISTED + b"element"), "lists in or before"),
    (spoiled(0, math.nan), "2 of 3 Gaussians are not finite"),
    (spoiled(1, 1e200, "double"), "2 of 3"),  # beyond float32
    ((PLY_DATA / "sharp, srgb.ply").read_bytes()[:-4], "cut off"),
    (GOOD.replace(b"binary_little_endian", b"ascii"), "a row of 'vertex' cannot be read"),
]


@pytest.mark.parametrize(("content", "says"), BAD, ids=[says for _, says in BAD])
def test_a_bad_file_is_refused_with_the_reason(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        load_ply(path)
    assert str(path) in str(caught.value)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    broken = random_gaussians(2 * ROWS_PER_BLOCK)
    broken.means[-1, 0] = math.nan
    save_ply(random_gaussians(3), path)
    before = path.read_bytes()
    for name in ("a.ply", "new.ply"):
        with pytest.raises(ValueError, match="not all finite"):
            save_ply(broken, tmp_path / name)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.ply"]


@pytest.mark.parametrize("name", ["nowhere/a.ply", ".", "a\0b.ply", "/dev/null"])
def test_where_a_file_cannot_be_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="cannot write"):
        save_ply(random_gaussians(1), tmp_path / name)
    assert not os.listdir(tmp_path)


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    save_ply(random_gaussians(3), tmp_path / "link")
    assert len(load_ply(tmp_path / "file")) == 3
