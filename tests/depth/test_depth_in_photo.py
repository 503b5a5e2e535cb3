"""The depth map inside a photo is read upright in metres; bad files are refused in one line."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.photos import picture, write_photo
from helpers.portraits import PORTRAITS, codes, write
from numpy.typing import NDArray
from PIL import Image, ImageOps

from spackle.core.photo import load_photo
from spackle.depth.depth_map import DepthMap
from spackle.depth.in_photo import layouts
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.runtime.errors import InputError

SHARE = codes().astype(np.float64) / 255
INVERSE, LINEAR = 1 / (2 + SHARE * (1 / 8 - 2)), 0.5 + 7.5 * SHARE  # 0.5 to 8 m


def found(tmp_path: Path, name: str) -> DepthMap:
    depth = load_photo_depth(write(tmp_path / "portrait.xyz", PORTRAITS[name]))
    assert depth is not None
    return depth


def between(first: float, last: float, values: NDArray[Any] = SHARE) -> NDArray[np.float64]:
    """Depth whose inverse runs linearly from `first` to `last`."""
    return 1 / (first + (last - first) * values)


def same(depth: DepthMap, expected: NDArray[Any]) -> None:
    assert (depth.depth.dtype, depth.valid.all().item()) == (torch.float32, True)
    np.testing.assert_allclose(depth.depth.numpy(), expected, rtol=1e-6)


def refused(tmp_path: Path, name: str, why: str) -> None:
    path = write(tmp_path / "bad.jpg", PORTRAITS[name])
    with pytest.raises(InputError, match=why) as caught:
        load_photo_depth(path)
    assert str(caught.value).startswith(f"{path}: the depth map in the photo cannot be used (")
    assert str(caught.value).endswith("`depth` FILE, or use `base` lite")
    assert "\n" not in str(caught.value)


ANDROID = ("GDepth, extended", "GDepth, one packet", "Dynamic Depth", "Dynamic Depth, extended")
TEN_BITS = (codes().astype(np.uint16) * 4 + np.arange(32, dtype=np.uint16) % 4) / 1023
SIXTEEN_BITS = (codes().astype(np.uint16) * 257 - np.uint16(3) * (codes() == 200)) / 65535


def gray(name: str) -> NDArray[Any]:
    return np.asarray(Image.open(io.BytesIO(PORTRAITS[name])).convert("L")) / 255


Layout = tuple[
    NDArray[Any], str, float | None, str
]  # depth, quantity, step, and the end of the note
DISPARITY = ("disparity", 2.5 / 255, "(Apple disparity, relative)")
LAYOUTS: dict[str, Layout] = {
    "HEIC, Apple's disparity": (between(0.5, 3), *DISPARITY),
    "HEIC, Apple's before HEVC's": (between(0.5, 3), *DISPARITY),
    "HEIC, Apple's before an uneven one": (between(0.5, 3), *DISPARITY),
    "HEIC, Apple's depth": (LINEAR, "depth", 7.5 / 255, "(Apple depth, absolute)"),
    "HEIC, ten bits": (between(0.5, 3, TEN_BITS), "disparity", 2.5 / 1023, "(HEIF disparity)"),
    "Apple JPEG": (between(0.5, 3, gray("map.jpg")), *DISPARITY),
}
for kind in ("HEVC", "MPEG-B"):
    LAYOUTS |= {
        f"HEIC, {kind}: inverse depth": (
            between(1 / 8, 2),
            "disparity",
            1.875 / 255,
            "(HEIF inverse depth)",
        ),
        f"HEIC, {kind}: disparity": (between(0.25, 3), "disparity", 2.75 / 255, "(HEIF disparity)"),
        f"HEIC, {kind}: depth": (LINEAR, "depth", 7.5 / 255, "(HEIF depth)"),
        f"HEIC, {kind}: no range": (
            between(0.1, 1),
            "disparity",
            0.9 / 255,
            "assumed to be 1 to 10 m)",
        ),
    }
for kind in ANDROID:
    LAYOUTS |= {
        f"{kind}: inverse, metres": (INVERSE, "disparity", 1.875 / 255, "Depth, in meters)"),
        f"{kind}: linear, millimetres": (LINEAR, "depth", 7.5 / 255, "in mm)"),
        f"{kind}: linear, dioptres": (INVERSE, "disparity", 1.875 / 255, "in diopters)"),
        f"{kind}: inverse, parsec": (INVERSE, "disparity", 1.875 / 255, "Depth, unit unknown)"),
        f"{kind}: 16 bits": (between(2, 1 / 8, SIXTEEN_BITS), "disparity", 1.875 / 65535, "in m)"),
        f"{kind}: map in colour": (
            between(2, 1 / 8, gray("map in colour.jpg")),
            "disparity",
            None,
            "in m)",
        ),
    }


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_depth_of_each_layout(tmp_path: Path, name: str) -> None:
    expected, quantity, quantum, note = LAYOUTS[name]
    depth = found(tmp_path, name)
    same(depth, expected)
    assert (depth.quantity, depth.path, depth.K) == (quantity, tmp_path / "portrait.xyz", None)
    assert quantum is None or depth.quantum == pytest.approx(quantum)
    assert depth.note.startswith("portrait depth of the photo (")
    assert depth.note.endswith(note)


def test_apples_image_type_decides_if_the_format_is_missing(tmp_path: Path) -> None:
    for kind in ("depth", "disparity"):
        depth = found(tmp_path, f"Apple JPEG, image type {kind}")
        assert depth.quantity == kind
        assert depth.note == f"portrait depth of the photo (Apple {kind}, of unknown accuracy)"


@pytest.mark.parametrize("kind", ANDROID)
def test_a_map_without_a_unit_gets_a_plausible_scale(tmp_path: Path, kind: str) -> None:
    factor = 3 / float(torch.from_numpy(INVERSE).median())
    for said in ("inverse, no unit", "inverse, dioptres"):  # Pixels write the second one
        depth = found(tmp_path, f"{kind}: {said}")
        same(depth, INVERSE * factor)
        assert depth.quantum == pytest.approx((2 - 1 / 8) / 255 / factor)
        assert depth.note.endswith("Depth, unit unknown, scaled to a median of 3 m)")
    linear = found(tmp_path, f"{kind}: linear, no unit")
    assert linear.quantum == pytest.approx(
        float(linear.depth.max() - linear.depth.min()) / 255, rel=1e-5
    )


def test_dynamic_depth_finds_its_item_whatever_the_lengths_mean(tmp_path: Path) -> None:
    expected = found(tmp_path, "Dynamic Depth: inverse, metres").depth
    names = [name for name in PORTRAITS if name.startswith("Dynamic Depth, item: ")]
    assert len(names) == 7
    for name in names:
        assert torch.equal(found(tmp_path, name).depth, expected), name


def test_disparity_below_zero_is_far_and_depth_of_zero_is_unknown(tmp_path: Path) -> None:
    depth = found(tmp_path, "HEIC, disparity from -0.1")
    assert bool(depth.valid.all())
    assert float(depth.depth.max()) == pytest.approx(1 / (2.55 / 255 / 2))
    assert depth.depth[0, 0] == depth.depth.max()
    assert float(depth.depth.min()) == pytest.approx(1 / 2.45)
    depth = found(tmp_path, "GDepth, depth from 0")
    assert torch.equal(depth.valid, torch.from_numpy(codes() > 0))
    assert torch.equal(depth.valid, depth.depth > 0)


def upright(stored: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Stored pixels, turned by an EXIF orientation."""
    image = Image.fromarray(stored)
    image.getexif()[0x0112] = orientation
    return np.asarray(ImageOps.exif_transpose(image))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    "kind", ["HEIC", "HEIC, map with its own turn", "Apple JPEG", "Dynamic Depth"]
)
def test_the_map_is_upright_as_the_photo_is(tmp_path: Path, kind: str, orientation: int) -> None:
    depth = found(tmp_path, f"{kind}, turned {orientation}")
    photo = load_photo(depth.path)
    np.testing.assert_allclose(photo.rgb.numpy() * 255, upright(picture(), orientation), atol=60)
    as_stored = found(tmp_path, f"{kind}, turned 1").depth.numpy()
    np.testing.assert_array_equal(depth.depth.numpy(), upright(as_stored, orientation))
    depth.check_aspect_ratio(photo.height, photo.width, depth.path)


@pytest.mark.parametrize(
    ("least", "greatest"),
    [(2.0, 2.0), (3.0, 2.0), (-2.0, -1.0), (1.0, math.inf), (math.nan, 2.0)],
)
def test_an_impossible_range_of_hevc_is_refused_where_it_is_read(
    least: float, greatest: float
) -> None:
    disparity = {"representation_type": 1, "d_min": least, "d_max": greatest}
    depth = {"representation_type": 2, "z_near": least, "z_far": greatest}
    for stated in (disparity, depth):
        with pytest.raises(ValueError, match=r"nothing can lie|it announces"):
            layouts.hevc_scale(stated)


def test_the_farthest_depth_of_hevc_may_be_the_horizon() -> None:
    scale = layouts.hevc_scale({"representation_type": 0, "z_near": 2.0, "z_far": math.inf})
    assert (scale.quantity, scale.first, scale.last) == ("disparity", 0.0, 0.5)


def test_photos_without_depth(tmp_path: Path) -> None:
    names = [name for name in PORTRAITS if name.startswith("no depth: ")]
    assert len(names) == 11
    for name in names:
        assert load_photo_depth(write(tmp_path / "photo.xyz", PORTRAITS[name])) is None, name
    assert load_photo_depth(write_photo(tmp_path / "photo.png")) is None
    with pytest.raises(InputError, match="no such photo"):
        load_photo_depth(tmp_path / "nowhere.jpg")


BAD = {
    "HEIC, uneven": "uneven size",
    "HEIC, far before near": "near 3 and far 2",
    "HEIC, nan": "FloatMinValue is nan",
    "Apple JPEG, empty range": "announces a disparity from 2 to 2",
    "HEIC, huge range": "no pixel has a depth",
    "Apple JPEG, tiny range": "no pixel has a depth",
    "GDepth, broken map": "broken",
    "Apple JPEG, broken XMP": "no element found",
    "Dynamic Depth, broken map": "broken",
    "GDepth, no picture": "cannot identify image file",
    "Apple JPEG, cut off": "the file ends before the map does",
    "HEIC, cut off": "cannot be used",
    "Dynamic Depth, cut off": "directory of items does not lead to a picture",
    "Dynamic Depth, another item": "directory of items",
    "Dynamic Depth, unknown measure": "the measure 'opticray' are not read",
    "Dynamic Depth, unknown format": "the format 'rangesquared'",
    "Dynamic Depth, far before near": "near 8 and far 0.5",
    "Dynamic Depth, huge range": "no pixel has a depth",
    "Dynamic Depth, near missing": "Near or Far is missing",
    "HEIC, all 0": "the same value",
    "HEIC, all 7": "the same value",
    "HEIC, all 255": "the same value",
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_maps_and_maps_without_a_meaning_are_refused(tmp_path: Path, name: str) -> None:
    refused(tmp_path, f"bad: {name}", BAD[name])


def test_the_parts_of_extended_xmp_may_come_in_any_order_beside_foreign_parts(
    tmp_path: Path,
) -> None:
    expected = found(tmp_path, "GDepth, many parts").depth
    for name in ("GDepth, many parts in reverse", "GDepth, many parts and one of another file"):
        assert torch.equal(found(tmp_path, name).depth, expected)


def test_huge_announced_sizes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small(width: int, height: int, size: int, path: str) -> None:
        if width * height > 700:
            raise InputError(f"{path}: {width}×{height} is too large")

    monkeypatch.setattr(layouts, "check_pixel_count", small)
    kinds = (
        "GDepth, extended: inverse, metres",
        "Dynamic Depth: inverse, metres",
        "HEIC, HEVC: no range",
    )
    for name in (*kinds, "Apple JPEG"):
        refused(tmp_path, name, "32×24 is too large")
