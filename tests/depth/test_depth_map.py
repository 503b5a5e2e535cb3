"""Depth maps: formats are read, depth and disparity are told apart, bad files are refused."""

from __future__ import annotations

import io
import json
import struct
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.portraits import png
from numpy.typing import NDArray
from PIL import Image

from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.depth.units import RELATIVE_KINDS, DepthKind
from spackle.runtime.errors import InputError

CALIB = """cam0=[1000.5 0 30.25; 0 1000.5 20.5; 0 0 1]
cam1=[1000.5 0 40.25; 0 1000.5 20.5; 0 0 1]
 doffs= 10.0
baseline=200.0
width=8
height=6
isint=0
"""
EXR = DATA / "exr"
BAD_EXR = ("lossy", "integers")


def ramp(height: int = 6, width: int = 8) -> NDArray[np.float32]:
    return np.linspace(1, 5, height * width, dtype=np.float32).reshape(height, width)


def pfm(values: NDArray[np.float32], endian: str = "<") -> bytes:
    height, width = values.shape
    header = f"Pf\n{width} {height}\n{'-' if endian == '<' else ''}0.0039\n".encode()
    return header + values[::-1].astype(f"{endian}f4").tobytes()


def as_bytes(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def zipped(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("arr_0.npy", content)
    return buffer.getvalue()


def same(found: DepthMap, expected: NDArray[Any], tolerance: float = 0.0) -> None:
    assert (found.depth.dtype, found.depth.shape) == (torch.float32, expected.shape)
    np.testing.assert_allclose(found.depth.numpy(), expected, rtol=tolerance)
    assert torch.equal(found.valid, found.depth > 0)


@pytest.mark.parametrize(
    ("dtype", "order"), [("<f2", "C"), ("<f4", "F"), (">f4", "C"), ("<f8", "C"), (">f8", "F")]
)
def test_npy(tmp_path: Path, dtype: str, order: Any) -> None:
    depth = ramp()
    depth[0, :3] = [np.nan, np.inf, 0]
    depth[1, 0] = 0 if dtype == "<f2" else 1e-41  # too small to invert
    np.save(tmp_path / "d.npy", np.asarray(depth.astype(dtype), order=order))
    found = load_depth(tmp_path / "d.npy")
    assert (~found.valid).sum() == 4
    same(
        found,
        np.where(np.isfinite(depth) & (depth > 1e-30), depth, 0),
        1e-3 if dtype == "<f2" else 0,
    )
    assert (found.K, found.quantum, found.quantity) == (None, None, "depth")


def test_npz_and_pfm_and_exr(tmp_path: Path) -> None:
    for endian in "<>":
        (tmp_path / "d.pfm").write_bytes(pfm(ramp(), endian))
        same(load_depth(tmp_path / "d.pfm"), ramp())
    np.savez_compressed(tmp_path / "one.npz", ramp())
    np.savez(tmp_path / "named.npz", depth=ramp(), other=np.zeros(3))
    np.savez(tmp_path / "none.npz", a=ramp(), b=ramp())
    same(load_depth(tmp_path / "one.npz"), ramp())
    same(load_depth(tmp_path / "named.npz"), ramp())
    with pytest.raises(InputError, match="none is called depth"):
        load_depth(tmp_path / "none.npz")
    for path in (EXR / "good").iterdir():  # written by OpenEXR
        same(
            load_depth(path),
            ramp(30, 40),
            1e-3 if "half" in path.name or "grey" in path.name else 0,
        )


@pytest.mark.parametrize(("left", "top"), [(2, 1), (-1, -1), (5, 4), (40, 0)])
def test_an_exr_with_pixels_for_a_part_of_the_picture(tmp_path: Path, left: int, top: int) -> None:
    exr = pytest.importorskip("OpenEXR")
    stored = ramp(3, 4)  # at (left, top) in a picture of 8×6, and perhaps beyond it
    header = {
        "type": exr.scanlineimage,
        "dataWindow": (np.int32([left, top]), np.int32([left + 3, top + 2])),
        "displayWindow": (np.int32([0, 0]), np.int32([7, 5])),
    }
    exr.File(header, {"Z": stored}).write(str(tmp_path / "part.exr"))
    expected = np.zeros((6, 8), np.float32)
    for y in range(6):
        for x in range(8):
            if 0 <= y - top < 3 and 0 <= x - left < 4:
                expected[y, x] = stored[y - top, x - left]
    if not expected.any():
        with pytest.raises(InputError, match="all-invalid"):
            load_depth(tmp_path / "part.exr")
        return
    same(load_depth(tmp_path / "part.exr"), expected)


def test_an_exr_of_several_parts_and_a_missing_package_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exr = pytest.importorskip("OpenEXR")
    parts = [exr.Part({"type": exr.scanlineimage}, {"Z": ramp()}, name) for name in "ab"]
    exr.File(parts).write(str(tmp_path / "parts.exr"))
    with pytest.raises(InputError, match="several parts"):
        load_depth(tmp_path / "parts.exr")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"pip install 'spackle-nvs\[exr\]'"):
        load_depth(EXR / "good" / "zips, depth.exr")


def test_millimetre_png(tmp_path: Path) -> None:
    stored = np.arange(48, dtype=np.uint16).reshape(6, 8) * 25 + 1000
    stored[0, 0], stored[5, 7] = 0, 65535
    Image.fromarray(stored).save(tmp_path / "d.png")
    found = load_depth(tmp_path / "d.png")
    same(found, np.where(stored == 65535, 0, stored) / 1000, 1e-6)
    assert found.quantum == pytest.approx(0.025)
    Image.fromarray(np.full((6, 8), 1234, np.uint16)).save(tmp_path / "flat.png")
    assert load_depth(tmp_path / "flat.png").quantum == pytest.approx(0.001)


@pytest.mark.parametrize("suffix", ["pfm", "npz", "npy", "png"])
@pytest.mark.parametrize("beside", [True, False])
def test_middlebury(tmp_path: Path, suffix: str, beside: bool) -> None:
    stored = np.arange(48, dtype=np.float32).reshape(6, 8) + 40
    stored[0, 0] = 0 if suffix == "png" else np.inf
    written = {"pfm": pfm(stored), "npy": as_bytes(stored), "npz": zipped(as_bytes(stored))}
    name = tmp_path / (f"disp0GT.{suffix}" if beside else f"x.{suffix}")
    name.write_bytes(written[suffix] if suffix in written else png(stored.astype(np.uint8)))
    calib = tmp_path / "calib.txt"
    calib.write_text(CALIB)
    found = load_depth(name) if beside else load_depth(name, calib=calib)
    expected = 0.2 * 1000.5 / (stored + 10)
    expected[0, 0] = 0
    same(found, expected, 1e-6)
    assert found.quantity == "disparity"
    assert found.quantum == pytest.approx(1 / (0.2 * 1000.5))
    assert found.K is not None
    assert found.K.tolist() == [[1000.5, 0, 30.25], [0, 1000.5, 20.5], [0, 0, 1]]
    np.save(tmp_path / "depth.npy", ramp())
    assert (
        load_depth(tmp_path / "depth.npy").quantity == "depth"
    )  # although the folder has a calibration
    np.save(tmp_path / "motorcycle_disp.npy", ramp())
    with pytest.raises(InputError, match="`calib`"):
        load_depth(tmp_path / "motorcycle_disp.npy")
    same(load_depth(name, calib=calib, focal_px=2001), 2 * expected, 1e-6)
    for focal in (0, -3, np.nan):
        with pytest.raises(InputError, match="give a focal length above 0"):
            load_depth(name, calib=calib, focal_px=focal)


def test_scene_json(tmp_path: Path) -> None:
    stored = np.tile(np.arange(0, 192, 24, dtype=np.uint8), (6, 1))
    stored[3] = np.arange(101, 109)
    Image.fromarray(stored).save(tmp_path / "disparity.png")
    scene = {
        "disparity": "disparity.png",
        "disparity_scale": 0.25,
        "invalid": 0,
        "focal_px": 900.0,
        "cx": 4,
        "cy": 3,
    }
    scene |= {"doffs_px": 5.0, "baseline_m": 0.1}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    found = load_depth(tmp_path / "disparity.png")
    same(found, np.where(stored > 0, 90.0 / (stored * 0.25 + 5), 0), 1e-6)
    assert found.quantum == pytest.approx(0.25 / 90)
    np.save(tmp_path / "depth.npy", ramp())
    assert load_depth(tmp_path / "depth.npy").quantity == "depth"
    assert load_depth(tmp_path / "depth.npy", calib=tmp_path / "scene.json").quantity == "disparity"
    texts = [json.dumps(scene | bad) for bad in ({"focal_px": 0}, {"baseline_m": None})]
    for text in (*texts, "{", "[]"):
        (tmp_path / "scene.json").write_text(text)
        with pytest.raises(InputError, match=r"scene\.json"):
            load_depth(tmp_path / "disparity.png")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        CALIB.replace("1000.5", "0"),
        CALIB.replace("cam0", "cam9"),
        CALIB.replace("200.0", "-1"),
        CALIB.replace("10.0", "ten"),
        CALIB.replace("width=8", "width=80"),
        "x" * 100_000,
    ],
)
def test_bad_calibrations(tmp_path: Path, text: str) -> None:
    (tmp_path / "d.pfm").write_bytes(pfm(ramp()))
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(InputError, match="calib") as caught:
        load_depth(tmp_path / "d.pfm", calib=tmp_path / "calib.txt")
    assert "\n" not in str(caught.value)


def greys(values: NDArray[Any], mode: str) -> bytes:
    """Numbers 0..1 as a grey picture."""
    if mode == "I;16":
        return png((values * 65535).round().astype(np.uint16))
    buffer = io.BytesIO()
    picture = Image.fromarray((values * 255).round().astype(np.uint8)).convert(mode)
    picture.save(buffer, "JPEG" if mode == "RGB" else "PNG", quality=95)
    return buffer.getvalue()


SLOPE = np.tile(np.linspace(0, 1, 100), (60, 1))


@pytest.mark.parametrize(
    ("content", "step"),
    [
        (greys(SLOPE, "L"), 1 / 255),
        (greys(SLOPE, "I;16"), 1 / 65535),
        (greys(SLOPE, "RGBA"), 1 / 255),  # as ComfyUI
        (greys(SLOPE, "RGB"), 1 / 255),
        (as_bytes(SLOPE), None),
        (as_bytes(np.float32(70 * SLOPE - 3)), None),  # as MiDaS
        (pfm(np.float32(0.01 * SLOPE + 5)), None),
    ],
)
@pytest.mark.parametrize("kind", RELATIVE_KINDS)
def test_relative_maps(tmp_path: Path, content: bytes, step: float | None, kind: DepthKind) -> None:
    (tmp_path / "map").write_bytes(content)
    for ends in ({}, {"near": 0.5, "far": 4.0}):
        near, far = ends.get("near", 1.5), ends.get("far", 15.0)
        found = load_depth(tmp_path / "map", kind=kind, **ends)
        assert bool(found.valid.all())
        start, middle, end = (float(found.depth[:, k].median()) for k in (1, 50, 98))
        half = (near + far) / 2 if kind == "near-black" else 2 / (1 / near + 1 / far)
        first, last = (near, far) if kind == "near-black" else (far, near)
        assert (start, middle, end) == pytest.approx((first, half, last), rel=0.04)
        assert (found.K, found.quantity) == (None, "depth" if kind == "near-black" else "disparity")
        span = far - near if kind == "near-black" else 1 / near - 1 / far
        assert found.quantum == (step and pytest.approx(step * span / 0.98, rel=0.02))
        assert f"{min(start, end):.2g}"[:2] in found.range_in_words


def npy_claiming(shape: str, descr: str = "<f4") -> bytes:
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + b"\0" * 64


NOISE = np.random.default_rng(0).integers(1, 60_000, (64, 64)).astype(np.uint16)
KINDS: list[tuple[bytes, dict[str, Any], str]] = [  # content, options, message
    (
        greys(SLOPE, "L"),
        {},
        "8 bits hold no metres: give `depth_kind` near-white",
    ),
    (greys(SLOPE, "I;16"), {}, "fill the range of 16 bits, .*: give `depth_kind` near-white"),
    (greys(SLOPE, "RGBA"), {}, "mode RGBA holds no millimetres: give `depth_kind` near-white"),
    (greys(SLOPE, "L"), {"kind": "disparity"}, "its folder has no calibration: give `calib`"),
    (
        as_bytes(SLOPE),
        {"kind": "near-white", "near": 3.0, "far": 2.0},
        "`near` 3, `far` 2: give two distances",
    ),
    (as_bytes(np.ones((9, 9))), {"kind": "near-black"}, "the same nearly everywhere"),
    (
        png(np.zeros((4, 4, 3), np.uint8) + np.uint8([200, 9, 9])),
        {"kind": "near-white"},
        "a colour picture",
    ),
    (b"hello there, I am text", {"kind": "near-white"}, "not an image"),
    (b"hello there, I am text", {}, "not a depth map"),
    (as_bytes(ramp())[:-5], {}, "cut off"),
    (npy_claiming("(1000000, 1000000)"), {}, "too large"),
    (as_bytes(np.ones((2, 3, 3), np.float32)), {}, "shape"),
    (as_bytes(np.ones((0, 5), np.float32)), {}, "shape"),
    (as_bytes(np.array([[None, 1]], dtype=object)), {}, "object"),
    (as_bytes(np.full((4, 4), np.nan)), {}, "all-invalid"),
    (as_bytes(np.array([[1.0, -2.0], [-0.5, np.nan]])), {}, "2 of 4 values are negative"),
    (as_bytes(NOISE), {}, "integers around .* are hardly metres: .* `depth_unit`"),
    (zipped(npy_claiming("(100000, 100000)")), {}, "too large"),
    (b"PF\n2 2\n-1\n" + b"\0" * 48, {}, "three channels"),
    (png(NOISE)[:2000], {}, "damaged"),
    ((EXR / "good" / "zips, depth.exr").read_bytes()[:-1], {}, "rows are missing"),
    *(
        ((EXR / "bad" / f"{name}.exr").read_bytes(), {}, f"an? .*{name}.*: (give|save)")
        for name in BAD_EXR
    ),
]


@pytest.mark.parametrize(("content", "options", "says"), KINDS)
def test_maps_that_are_damaged_or_of_another_kind_are_refused(
    tmp_path: Path, content: bytes, options: Any, says: str
) -> None:
    path = tmp_path / "map.dat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{says}.*") as caught:
        load_depth(path, **options)
    assert "near" in options or str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_shape_against_the_photo(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.ones((480, 640), np.float32))
    found = load_depth(tmp_path / "d.npy")
    found.check_aspect_ratio(959, 1281, "a.jpg")
    for height, width in [(640, 480), (480, 680), (100, 100)]:
        with pytest.raises(InputError, match=r"is 640×480 but photo a\.jpg is"):
            found.check_aspect_ratio(height, width, "a.jpg")
