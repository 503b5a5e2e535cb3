"""The depth map inside a photo is read upright in metres from each layout, and bad files are refused in one line."""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import portraits
import pytest
import torch
from numpy.typing import NDArray
from photos import picture, write_photo
from PIL import Image
from portraits import Range, apple_xmp, codes, png, upright

from spackle.bases.depth_map import DepthMap
from spackle.bases.photo_depth import layouts
from spackle.bases.photo_depth.layouts import load_photo_depth
from spackle.errors import InputError
from spackle.image import load_photo

SHARE = codes().astype(np.float64) / 255
INVERSE, LINEAR = 1 / (2 + SHARE * (1 / 8 - 2)), 0.5 + 7.5 * SHARE  # 0.5 to 8 m


def found(tmp_path: Path, data: bytes) -> DepthMap:
    depth = load_photo_depth(portraits.write(tmp_path / "portrait.xyz", data))
    assert depth is not None
    return depth


def between(first: float, last: float, values: NDArray[Any] = SHARE) -> NDArray[np.float64]:
    """Depth whose inverse runs linearly from `first` to `last`."""
    return 1 / (first + (last - first) * values)


def same(depth: DepthMap, expected: NDArray[Any]) -> None:
    assert (depth.depth.dtype, depth.valid.all().item()) == (torch.float32, True)
    np.testing.assert_allclose(depth.depth.numpy(), expected, rtol=1e-6)


def refused(tmp_path: Path, data: bytes, why: str) -> None:
    path = portraits.write(tmp_path / "bad.jpg", data)
    with pytest.raises(InputError, match=why) as caught:
        load_photo_depth(path)
    assert str(caught.value).startswith(f"{path}: the depth map in the photo cannot be used (")
    assert str(caught.value).endswith("--depth FILE, or use --base lite")
    assert "\n" not in str(caught.value)


ANDROID: dict[str, Callable[..., bytes]] = {
    "GDepth, extended": portraits.gdepth_jpeg,
    "GDepth, one packet": functools.partial(portraits.gdepth_jpeg, part=None),
    "Dynamic Depth": portraits.dynamic_jpeg,
    "Dynamic Depth, extended": functools.partial(portraits.dynamic_jpeg, extended=True),
}
each_of_android = pytest.mark.parametrize("make", ANDROID.values(), ids=ANDROID)
TEN_BITS = (codes().astype(np.uint16) * 4 + np.arange(32, dtype=np.uint16) % 4) << 6
SIXTEEN_BITS = codes().astype(np.uint16) * 257 - np.uint16(3) * (codes() == 200)
LOSSY = portraits.jpeg(np.repeat(codes()[..., None], 3, axis=-1))


def gray(picture: bytes) -> NDArray[Any]:
    return np.asarray(Image.open(io.BytesIO(picture)).convert("L")) / 255


def layouts_read() -> Iterator[tuple[str, bytes, NDArray[Any], str, float, str]]:
    """Name, file, depth, quantity, step, and the end of the note."""
    apple, hevc = ("disparity", 2.5 / 255, "(Apple disparity, relative)"), portraits.heic
    yield "HEIC, Apple's disparity", hevc(codes(), apple_xmp()), between(0.5, 3), *apple
    both = hevc(codes(), apple_xmp(), information="depth, 1 to 2 m")
    yield "HEIC, Apple's before HEVC's", both, between(0.5, 3), *apple
    absolute = hevc(codes(), apple_xmp("fdep", (0.5, 8.0), "absolute"))
    yield "HEIC, Apple's depth", absolute, LINEAR, "depth", 7.5 / 255, "(Apple depth, absolute)"
    fine = hevc(TEN_BITS, information="disparity, 0.5 to 3")
    yield "HEIC, ten bits", fine, between(0.5, 3, (TEN_BITS >> 6) / 1023), "disparity", 2.5 / 1023, "(HEIF disparity)"
    for kind in (portraits.HEVC, b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth"):
        for words, depth, *rest in (
            ("inverse, 0.5 to 8 m", between(1 / 8, 2), "disparity", 1.875 / 255, "(HEIF inverse depth)"),
            ("disparity, 0.25 to 3", between(0.25, 3), "disparity", 2.75 / 255, "(HEIF disparity)"),
            ("depth, 0.5 to 8 m", LINEAR, "depth", 7.5 / 255, "(HEIF depth)"),
            ("", between(0.1, 1), "disparity", 0.9 / 255, "assumed to be 1 to 10 m)"),
        ):
            yield f"HEIC, {kind!r}: {words}", hevc(codes(), information=words, kind=kind), depth, *rest
    yield "JPEG, Apple's", portraits.apple_jpeg(codes()), between(0.5, 3, gray(portraits.jpeg(codes()))), *apple
    for name, make in ANDROID.items():
        inverse, linear = ("disparity", 1.875 / 255), ("depth", 7.5 / 255)
        for image, said, depth, *rest in (
            (png(codes()), Range(unit="Meters"), INVERSE, *inverse, "Depth, in meters)"),
            (png(codes()), Range(500, 8000, "RangeLinear", unit="mm"), LINEAR, *linear, "in mm)"),
            (png(codes()), Range(2, 0.125, "RangeLinear", unit="Diopters"), INVERSE, *inverse, "in diopters)"),
            (png(codes()), Range(0.5, 8, unit="parsec"), INVERSE, *inverse, "Depth, unit unknown)"),
            (png(SIXTEEN_BITS), Range(), between(2, 1 / 8, SIXTEEN_BITS / 65535), "disparity", 1.875 / 65535, "in m)"),
            (LOSSY, Range(), between(2, 1 / 8, gray(LOSSY)), "disparity", None, "in m)"),
        ):
            yield f"{name}, {said}", make(image, said), depth, *rest


LAYOUTS = {name: row for name, *row in layouts_read()}


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_depth_of_each_layout(tmp_path: Path, name: str) -> None:
    data, expected, quantity, quantum, note = LAYOUTS[name]
    depth = found(tmp_path, data)
    same(depth, expected)
    assert (depth.quantity, depth.path, depth.K) == (quantity, tmp_path / "portrait.xyz", None)
    assert quantum is None or depth.quantum == pytest.approx(quantum)
    assert depth.note.startswith("portrait depth of the photo (")
    assert depth.note.endswith(note)


def test_apples_image_type_decides_if_the_format_is_missing(tmp_path: Path) -> None:
    for kind in ("depth", "disparity"):
        said = f"<apdi:AuxiliaryImageType>{kind}</apdi:AuxiliaryImageType>"
        depth = found(tmp_path, portraits.apple_jpeg(codes(), apple_xmp(None, accuracy="great", more=said)))
        assert depth.quantity == kind
        assert depth.note == f"portrait depth of the photo (Apple {kind}, of unknown accuracy)"
    matte = "<apdi:AuxiliaryImageSubType>portraiteffectsmatte</apdi:AuxiliaryImageSubType>"
    matte = portraits.apple_jpeg(codes(), apple_xmp(None, more=said + matte))
    assert load_photo_depth(portraits.write(tmp_path / "matte.jpg", matte)) is None


@each_of_android
def test_a_map_without_a_unit_gets_a_plausible_scale(tmp_path: Path, make: Callable[..., bytes]) -> None:
    factor = 3 / float(torch.from_numpy(INVERSE).median())
    for said in (Range(50, 800, unit=None), Range(0.005, 0.08, unit="Diopters")):  # Pixels write the second one
        depth = found(tmp_path, make(png(codes()), said))
        same(depth, INVERSE * factor)
        assert depth.quantum == pytest.approx((2 - 1 / 8) / 255 / factor)
        assert depth.note.endswith("Depth, unit unknown, scaled to a median of 3 m)")
    linear = found(tmp_path, make(png(codes()), Range(50, 800, "RangeLinear", unit=None)))
    assert linear.quantum == pytest.approx(float(linear.depth.max() - linear.depth.min()) / 255, rel=1e-5)


def test_dynamic_depth_finds_its_item_whatever_the_lengths_mean(tmp_path: Path) -> None:
    expected = found(tmp_path, portraits.dynamic_jpeg(png(codes()))).depth
    for data in (
        portraits.dynamic_jpeg(png(codes()), padding=37),
        portraits.dynamic_jpeg(png(codes()), padding=37, extended=True, trailer=b"camera's own bytes"),
        portraits.dynamic_jpeg(png(codes()), length=0),  # to the end of the file
        portraits.dynamic_jpeg(png(codes()), padding=37).replace(b'Item:Padding="37"', b'Item:Padding="0" '),
        portraits.dynamic_jpeg(png(codes()), trailer=b"x" * 99).replace(b'Item:Padding="0"', b'Item:Padding="9"'),
        portraits.dynamic_jpeg(png(codes()), trailer=b"x" * 99, primary=5000),
        portraits.dynamic_jpeg(png(codes())).replace(b"\xff\xd9", b"\xff\0"),  # a photo without an end
    ):
        assert torch.equal(found(tmp_path, data).depth, expected)


def test_disparity_below_zero_is_far_and_depth_of_zero_is_unknown(tmp_path: Path) -> None:
    depth = found(tmp_path, portraits.heic(codes(), apple_xmp(ends=(-0.1, 2.45))))
    assert bool(depth.valid.all())
    assert float(depth.depth.max()) == pytest.approx(1 / (2.55 / 255 / 2))
    assert depth.depth[0, 0] == depth.depth.max()
    assert float(depth.depth.min()) == pytest.approx(1 / 2.45)
    depth = found(tmp_path, portraits.gdepth_jpeg(png(codes()), Range(0, 8, "RangeLinear")))
    assert torch.equal(depth.valid, torch.from_numpy(codes() > 0))
    assert torch.equal(depth.valid, depth.depth > 0)


MAKERS: dict[str, Callable[..., bytes]] = {
    "HEIC": lambda map_, way: portraits.heic(map_, apple_xmp(), way),
    "HEIC, map with its own turn": lambda map_, way: portraits.heic(map_, apple_xmp(), way, own_turn=True),
    "Apple JPEG": lambda map_, way: portraits.apple_jpeg(map_, orientation=way),
    "Dynamic Depth": lambda map_, way: portraits.dynamic_jpeg(png(map_), orientation=way),
}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_the_map_is_upright_as_the_photo_is(tmp_path: Path, make: Callable[..., bytes], orientation: int) -> None:
    path = portraits.write(tmp_path / "portrait.xyz", make(codes(), orientation))
    photo, depth = load_photo(path), load_photo_depth(path)
    np.testing.assert_allclose(photo.rgb.numpy() * 255, upright(picture(), orientation), atol=60)
    assert depth is not None
    as_stored = found(tmp_path, make(codes(), 1)).depth.numpy()
    np.testing.assert_array_equal(depth.depth.numpy(), upright(as_stored, orientation))
    depth.check_shape(photo.height, photo.width, path)


def extension_of(data: bytes) -> tuple[bytes, list[bytes], bytes]:
    """A JPEG's bytes before its extended XMP, the segments of the extended XMP, and the bytes after them."""
    starts = [i - 4 for i in range(len(data)) if data.startswith(b"http://ns.adobe.com/xmp/extension/", i)]
    ends = [start + 2 + struct.unpack(">H", data[start + 2 : start + 4])[0] for start in starts]
    return data[: starts[0]], [data[a:b] for a, b in zip(starts, ends, strict=True)], data[ends[-1] :]


def test_photos_without_depth(tmp_path: Path) -> None:
    other, gain_map = portraits.jpeg(codes()), b"urn:com:apple:photo:2020:aux:hdrgainmap"
    head, parts, tail = extension_of(portraits.gdepth_jpeg(png(codes())))
    odd = portraits.with_segments(other, portraits.xmp_segment(b"<<<not XML"))
    no_range = apple_xmp().replace(b"apdi:FloatMaxValue", b"apdi:FloatMiddle")
    files = {
        "plain.jpg": portraits.jpeg(picture()),
        "beyond.jpg": portraits.multi_picture(portraits.jpeg(picture()), other, shift=1 << 30),
        "without_extended_xmp.jpg": head + tail,
        "part_missing.jpg": head + b"".join(parts[1:]) + tail,
        "no_range.jpg": portraits.apple_jpeg(codes(), no_range),
        "plain.heic": portraits.heic(None),
        "gain.heic": portraits.heic(codes(), apple_xmp(), kind=gain_map),
        "start.jpg": b"\xff\xd8\xff\xe1\xff\xff" + bytes(20),
        "odd.jpg": portraits.multi_picture(odd, odd),
        "broken.heic": portraits.heic(codes()).replace(b"mif1heic\0", b"mif1heic\xff"),  # a box beyond the file
    }
    for name, data in files.items():
        assert load_photo_depth(portraits.write(tmp_path / name, data)) is None, name
    assert load_photo_depth(write_photo(tmp_path / "photo.png")) is None
    with pytest.raises(InputError, match="no such photo"):
        load_photo_depth(tmp_path / "nowhere.jpg")


def test_damaged_maps_and_maps_without_a_meaning_are_refused(tmp_path: Path) -> None:
    image, apple, dynamic = png(codes()), portraits.apple_jpeg(codes()), portraits.dynamic_jpeg(png(codes()))
    broken, heic = image[:60] + bytes(30) + image[90:], portraits.heic(codes(), apple_xmp())
    uneven = "uneven disparity, 0.25 to 3"
    for data, why in (
        (portraits.heic(codes(), information=uneven), "uneven size"),
        (portraits.heic(codes(), information="inverse, 3 to 2 m"), "near 3 and far 2"),
        (portraits.heic(codes(), apple_xmp(ends=("nan", 3))), "FloatMinValue is nan"),
        (portraits.apple_jpeg(codes(), apple_xmp(ends=(2, 2))), "announces a disparity from 2 to 2"),
        (portraits.heic(codes(), apple_xmp(ends=(-1e308, 1.1e308))), "no pixel has a depth"),
        (portraits.apple_jpeg(codes(), apple_xmp(ends=(1e-320, 1e-310))), "no pixel has a depth"),
        (portraits.gdepth_jpeg(broken), "broken"),
        (portraits.apple_jpeg(codes(), b"<a><!-- http://ns.apple.com/pixeldatainfo/1.0/ -->"), "no element found"),
        (portraits.dynamic_jpeg(broken), "broken"),
        (portraits.gdepth_jpeg(b"GIF89a" + image), "cannot identify image file"),
        (apple[:-20], "the file ends before the map does"),
        (heic[: heic.rindex(b"mdat") + 40], "cannot be used"),
        (dynamic[:-20], "directory of items does not lead to a picture"),
        (dynamic.replace(b'DepthURI="android/depthmap"', b'DepthURI="android/deepmap1"'), "directory of items"),
        (portraits.dynamic_jpeg(image, Range(measure="OpticRay")), "the measure 'opticray' are not read"),
        (portraits.dynamic_jpeg(image, Range(style="RangeSquared")), "the format 'rangesquared'"),
        (portraits.dynamic_jpeg(image, Range(8, 0.5)), "near 8 and far 0.5"),
        (portraits.dynamic_jpeg(image, Range(1e300, 1e305)), "no pixel has a depth"),
        (portraits.dynamic_jpeg(image).replace(b":Near", b":Nxxx"), "Near or Far is missing"),
        *((portraits.heic(np.full((24, 32), flat, np.uint8), apple_xmp()), "the same value") for flat in (0, 7, 255)),
    ):
        refused(tmp_path, data, why)
    same(found(tmp_path, portraits.heic(codes(), apple_xmp(), information=uneven)), between(0.5, 3))


def test_the_parts_of_extended_xmp_may_come_in_any_order_beside_foreign_parts(tmp_path: Path) -> None:
    data = portraits.gdepth_jpeg(png(codes()), part=100)
    expected = found(tmp_path, data).depth
    head, parts, tail = extension_of(data)
    assert len(parts) > 4
    foreign = parts[0].replace(parts[0][39:71], b"0" * 32)
    for mixed in (reversed(parts), [foreign, *parts]):
        assert torch.equal(found(tmp_path, head + b"".join(mixed) + tail).depth, expected)


def test_huge_announced_sizes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small(width: int, height: int, size: int, path: str) -> None:
        if width * height > 700:
            raise InputError(f"{path}: {width}×{height} is too large")

    monkeypatch.setattr(layouts, "check_pixels", small)
    google = portraits.gdepth_jpeg(png(codes())), portraits.dynamic_jpeg(png(codes()))
    for data in (*google, portraits.apple_jpeg(codes()), portraits.heic(codes())):
        refused(tmp_path, data, "32×24 is too large")
