"""Scene files that claim far more than they can hold are refused before memory is taken."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.scenes import random_scene, turned_camera
from PIL import Image

from spackle.core.gaussians import Gaussians
from spackle.formats import zstandard
from spackle.formats.ply import PlyFile, save_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS, SCENE_READERS, load_scene
from spackle.formats.scene_limits import (
    HARMLESS_BYTES,
    MAX_BYTES_PER_FILE_BYTE,
    check_gaussian_count,
    check_unpacked_bytes,
)
from spackle.formats.sog import encode_sog
from spackle.runtime.errors import InputError

MAX_TRACED_BYTES = 40_000_000  # that a refusal may take; a bomb would take a gigabyte


def spz_bomb(count: int) -> bytes:
    """An SPZ file of version 3 with `count` equal Gaussians with harmonics of degree 3."""
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0)
    compressor = zlib.compressobj(9, zlib.DEFLATED, 31)
    parts = [compressor.compress(header)]
    # 65 bytes a Gaussian, of which a million zeros at a time are compressed.
    parts += [compressor.compress(bytes(1_000_000)) for _ in range(65 * count // 1_000_000 + 1)]
    return b"".join([*parts, compressor.flush()])


def spz_4_bomb(count: int) -> bytes:
    """An SPZ file of version 4 with `count` equal Gaussians."""
    widths = (9, 1, 3, 3, 4)
    frames = [zstandard.compress(bytes(width * count)) for width in widths]
    table = b"".join(
        struct.pack("<QQ", len(frame), width * count)
        for frame, width in zip(frames, widths, strict=True)
    )
    header = struct.pack("<IIIBBBB", 0x5053474E, 4, count, 0, 12, 0, len(frames))
    return header + struct.pack("<I12x", 32) + table + b"".join(frames)


def webp(width: int, height: int, color: tuple[int, int, int, int]) -> bytes:
    file = io.BytesIO()
    Image.new("RGBA", (width, height), color).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def sog_bomb(side: int, *, harmonics: bool = True, meta_padding: int = 0) -> bytes:
    """A SOG archive of side² equal Gaussians, with harmonics of degree 3."""
    meta = {
        "version": 2,
        "count": side * side,
        "means": {"mins": [0] * 3, "maxs": [1] * 3, "files": ["a.webp", "a.webp"]},
        "scales": {"codebook": [-3] * 256, "files": ["a.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [0] * 256, "files": ["a.webp"]},
    }
    palette = {"count": 64, "bands": 3, "codebook": [0] * 256, "files": ["c.webp", "l.webp"]}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        text = json.dumps(meta | ({"shN": palette} if harmonics else {}))
        archive.writestr("meta.json", text + " " * meta_padding)
        archive.writestr("a.webp", webp(side, side, (9, 9, 9, 255)))
        archive.writestr("quats.webp", webp(side, side, (9, 9, 9, 252)))
        archive.writestr("c.webp", webp(64 * 15, 1, (9, 9, 9, 255)))
        archive.writestr("l.webp", webp(side, side, (0, 0, 0, 255)))
    return file.getvalue()


def glb_bomb(node_count: int) -> bytes:
    """A glTF file that shows the same 10,000 Gaussians many times."""
    scene = random_scene(1, 10_000, turned_camera(40, 30, 40.0))
    content = SCENE_ENCODERS[".glb"](SceneFile(Path("a.glb"), scene))
    (json_bytes,) = struct.unpack_from("<I", content, 12)
    description = json.loads(content[20 : 20 + json_bytes])
    mesh = next(node for node in description["nodes"] if "mesh" in node)
    description["nodes"] = [mesh] * node_count
    description["scenes"] = [{"nodes": list(range(node_count))}]
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + json_bytes :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + rest


@pytest.mark.parametrize(
    ("name", "make", "says"),
    [
        ("a.spz", lambda: spz_bomb(400_000), "it claims 400,000 Gaussians in "),
        ("a.v4.spz", lambda: spz_4_bomb(2_000_000), "it claims 2,000,000 Gaussians in "),
        ("a.sog", lambda: sog_bomb(600), "it claims 360,000 Gaussians in "),
        ("b.sog", lambda: sog_bomb(1200, harmonics=False), "it claims 1,440,000 Gaussians in "),
        ("c.sog", lambda: sog_bomb(8, meta_padding=5_000_000), "meta.json is too large"),
        ("a.glb", lambda: glb_bomb(130), "Gaussians in "),
    ],
)
def test_a_small_file_that_claims_a_huge_scene_is_refused_before_it_is_unpacked(
    tmp_path: Path, name: str, make: Callable[[], bytes], says: str
) -> None:
    path = tmp_path / name
    path.write_bytes(make())
    assert path.stat().st_size < 1_000_000
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=says) as refusal:
            load_scene(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(path) in str(refusal.value)
    # The copies of a glTF are counted as they are read.
    assert peak < (HARMLESS_BYTES * 3 if name == "a.glb" else MAX_TRACED_BYTES)


def test_every_format_asks_the_one_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = SceneFile(tmp_path / "a.ply", random_scene(1, 200, turned_camera(40, 30, 40.0)))
    files = []
    for suffix, encode in SCENE_ENCODERS.items():
        files.append(tmp_path / f"a{suffix}")
        files[-1].write_bytes(encode(scene))
        load_scene(files[-1])
    assert {file.suffix for file in files} == {".ply", *SCENE_READERS} - {".gltf"}
    # If nothing were harmless, and no file could hold what it holds, each would be refused.
    monkeypatch.setattr("spackle.formats.scene_limits.HARMLESS_BYTES", 0)
    monkeypatch.setattr("spackle.formats.scene_limits.MAX_BYTES_PER_FILE_BYTE", 0.1)
    for file in files:
        with pytest.raises(InputError, match=r"claims [\d,]+ (Gaussians|bytes) in "):
            load_scene(file)


def test_an_ordinary_scene_has_room_to_spare(tmp_path: Path) -> None:
    # The smallest file of a real scene: harmonics that all Gaussians share, as SOG.
    count = 2000
    scene = random_scene(1, count, turned_camera(40, 30, 40.0))
    harmonics = torch.rand(count, 15, 3) * 0.1
    file = SceneFile(tmp_path / "a.ply", Gaussians(*scene.tensors[:5], harmonics))
    memory_bytes = count * (56 + 12 * 15)
    assert memory_bytes < MAX_BYTES_PER_FILE_BYTE / 3 * len(encode_sog(file))
    check_gaussian_count(1_000_000, 0, 1)
    check_unpacked_bytes("a", HARMLESS_BYTES, 1)
    with pytest.raises(ValueError, match="it claims"):
        check_gaussian_count(1_000_000, 1, 1)


def test_packed_vertices_without_chunks_are_called_so(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    scene = random_scene(1, 300, turned_camera(40, 30, 40.0))
    save_ply(scene, tmp_path / "a.ply")
    content = SCENE_ENCODERS[".compressed.ply"](load_scene(tmp_path / "a.ply"))
    names = ("element chunk", "property float")
    head, end, rows = content.partition(b"end_header\n")
    lines = [line for line in head.decode().splitlines() if not line.startswith(names)]
    # Two chunks of 256 Gaussians, with 18 floats each, come before the vertices.
    path.write_bytes("\n".join([*lines, ""]).encode() + end + rows[2 * 18 * 4 :])
    for read in (load_scene, lambda path: PlyFile(path).gaussians()):
        with pytest.raises(InputError, match="packed, and the table of their chunks is missing"):
            read(path)
