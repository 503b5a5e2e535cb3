"""The depth map inside a photo: every layout read back, upright, in metres; every bad file refused."""

from __future__ import annotations

import contextlib
import functools
import io
import struct
import time
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
from spackle.image import film_to_pixels, load_photo

LENS = (70.0, 0.0, 0.0, 0.0, 50.0, 0.0, 20.0, 30.0, 1.0)  # of the whole photo, column by column
MODEL: dict[str, object] = {"FocalLengthX": 70.0, "FocalLengthY": 50.0, "ImageWidth": 64, "ImageHeight": 48}
MODEL |= {"PrincipalPointX": 20.0, "PrincipalPointY": 30.0}
SHARE = codes().astype(np.float64) / 255
INVERSE, LINEAR = 1 / (2 + SHARE * (1 / 8 - 2)), 0.5 + 7.5 * SHARE  # 0.5 to 8 m


def found(tmp_path: Path, data: bytes) -> DepthMap:
    depth = load_photo_depth(portraits.write(tmp_path / "portrait.xyz", data))
    assert depth is not None
    return depth


def between(first: float, last: float, values: NDArray[Any] = SHARE) -> NDArray[np.float64]:
    """Depth where disparity runs evenly from one to another."""
    return 1 / (first + (last - first) * values)


def same(depth: DepthMap, expected: NDArray[Any]) -> None:
    assert (depth.depth.dtype, depth.valid.all().item()) == (torch.float32, True)
    np.testing.assert_allclose(depth.depth.numpy(), expected, rtol=1e-6)


def refused(tmp_path: Path, data: bytes, why: str) -> None:
    path = portraits.write(tmp_path / "bad.jpg", data)
    with pytest.raises(InputError, match=why) as caught:
        load_photo_depth(path)
    assert str(caught.value).startswith(f"{path}: ")
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
    """What Pillow makes of a picture, in shares of its highest value."""
    return np.asarray(Image.open(io.BytesIO(picture)).convert("L")) / 255


def layouts_read() -> Iterator[tuple[str, bytes, NDArray[Any], str, float, str]]:
    """Name, file, depth, quantity, step, and how the note ends."""
    apple, hevc = ("disparity", 2.5 / 255, "(Apple disparity, relative)"), portraits.heic
    yield "HEIC, Apple's disparity", hevc(codes(), apple_xmp(matrix=LENS)), between(0.5, 3), *apple
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
    for order in "<>":  # not the gain map or the matte before it
        data = portraits.apple_jpeg(codes(), apple_xmp(matrix=LENS), order=order)
        yield f"JPEG, Apple's {order}", data, between(0.5, 3, gray(portraits.jpeg(codes()))), *apple
    for name, make in ANDROID.items():
        inverse, linear = ("disparity", 1.875 / 255), ("depth", 7.5 / 255)
        for image, said, depth, *rest in (
            (png(codes()), Range(unit="Meters"), INVERSE, *inverse, "Depth, in meters)"),
            (png(codes()), Range(style="RangeLinear"), LINEAR, *linear, "Depth, in m)"),
            (png(codes()), Range(500, 8000, unit="mm"), INVERSE, *inverse, "in mm)"),
            (png(codes()), Range(2, 0.125, unit="Diopters"), LINEAR, *linear, "in diopters)"),
            (png(codes()), Range(2, 0.125, "RangeLinear", unit="Diopters"), INVERSE, *inverse, "in diopters)"),
            (png(codes()), Range(0.5, 8, unit="parsec"), INVERSE, *inverse, "Depth, unit unknown)"),
            (png(SIXTEEN_BITS), Range(), between(2, 1 / 8, SIXTEEN_BITS / 65535), "disparity", 1.875 / 65535, "in m)"),
            (LOSSY, Range(), between(2, 1 / 8, gray(LOSSY)), "disparity", None, "in m)"),
            (png(codes()), Range(50, 800), 100 * INVERSE, "disparity", 0.01875 / 255, "in m)"),
        ):
            yield f"{name}, {said}", make(image, said), depth, *rest


LAYOUTS = {name: row for name, *row in layouts_read()}


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_depth_of_each_layout(tmp_path: Path, name: str) -> None:
    data, expected, quantity, quantum, note = LAYOUTS[name]
    depth = found(tmp_path, data)
    same(depth, expected)
    assert (depth.quantity, depth.path) == (quantity, tmp_path / "portrait.xyz")
    assert quantum is None or depth.quantum == pytest.approx(quantum)
    assert depth.note.startswith("portrait depth of the photo (")
    assert depth.note.endswith(note)
    assert (depth.K is None) == (data.count(b"IntrinsicMatrixReferenceWidth") == 0)
    assert depth.K is None or depth.K.tolist() == [[35, 0, 10], [0, 25, 15], [0, 0, 1]]


def test_apples_type_counts_where_the_format_is_not_given(tmp_path: Path) -> None:
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
    for said in (Range(50, 800, unit=None), Range(0.005, 0.08, unit="Diopters")):  # the latter is a Pixel's habit
        depth = found(tmp_path, make(png(codes()), said))
        same(depth, INVERSE * factor)
        assert depth.quantum == pytest.approx((2 - 1 / 8) / 255 / factor)
        assert depth.note.endswith("Depth, unit unknown, scaled to a median of 3 m)")
    linear = found(tmp_path, make(png(codes()), Range(50, 800, "RangeLinear", unit=None)))
    assert linear.quantum == pytest.approx(float(linear.depth.max() - linear.depth.min()) / 255, rel=1e-5)


def test_distances_along_the_ray_become_depth(tmp_path: Path) -> None:
    plain = found(tmp_path, portraits.dynamic_jpeg(png(codes()), orientation=6))
    y, x = np.mgrid[:24, :32] + 0.5
    default = film_to_pixels(30, 48, 64) / 2
    for model, fx, fy, cx, cy in ((MODEL, 35, 25, 10, 15), (None, default, default, 16, 12)):
        data = portraits.dynamic_jpeg(png(codes()), Range(measure="OpticRay"), model=model, orientation=6)
        along = found(tmp_path, data)
        length = np.sqrt(1 + ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2)
        same(along, plain.depth.numpy() / np.rot90(length, -1))
        assert along.quantum is None


def test_the_lens_is_the_maps_where_it_can_be_its(tmp_path: Path) -> None:
    shares = MODEL | {"PrincipalPointX": 20 / 64, "PrincipalPointY": 30 / 48}
    without = {name: value for name, value in MODEL.items() if "Point" not in name}
    for model, center in ((MODEL, (10, 15)), (shares, (10, 15)), (without, (16, 12))):
        K = found(tmp_path, portraits.dynamic_jpeg(png(codes()), model=model)).K
        assert K is not None
        np.testing.assert_allclose(K, [[35, 0, center[0]], [0, 25, center[1]], [0, 0, 1]], rtol=1e-6)
    changes: list[dict[str, object]] = [{"FocalLengthX": 0.1}, {"FocalLengthY": "nan"}, {"ImageWidth": 0}]
    for change in (*changes, {"ImageHeight": 64}, {"PrincipalPointX": -1}, {"ImageHeight": "tall"}):
        assert found(tmp_path, portraits.dynamic_jpeg(png(codes()), model=MODEL | change)).K is None
    for matrix, size in ((LENS[:8], (64, 48)), (LENS, (48, 64)), (LENS, ("x", 48)), (("a", *LENS[1:]), (64, 48))):
        data = portraits.apple_jpeg(codes(), apple_xmp(matrix=matrix, size=size))
        assert found(tmp_path, data).K is None


def test_dynamic_depth_finds_its_item_however_the_lengths_are_meant(tmp_path: Path) -> None:
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


def test_disparity_beyond_the_horizon_is_far_not_unknown(tmp_path: Path) -> None:
    depth = found(tmp_path, portraits.heic(codes(), apple_xmp(ends=(-0.1, 2.45))))
    assert bool(depth.valid.all())
    assert float(depth.depth.max()) == pytest.approx(1 / (2.55 / 255 / 2))
    assert depth.depth[0, 0] == depth.depth.max()
    assert float(depth.depth.min()) == pytest.approx(1 / 2.45)
    depth = found(tmp_path, portraits.gdepth_jpeg(png(codes()), Range(0, 8, "RangeLinear")))
    assert torch.equal(depth.valid, torch.from_numpy(codes() > 0))  # depth that is not above zero is unknown
    assert torch.equal(depth.valid, depth.depth > 0)


MAKERS: dict[str, Callable[..., bytes]] = {
    "HEIC": lambda map_, way: portraits.heic(map_, apple_xmp(matrix=LENS), way),
    "HEIC, map with its own turn": lambda map_, way: portraits.heic(map_, apple_xmp(matrix=LENS), way, own_turn=True),
    "Apple JPEG": lambda map_, way: portraits.apple_jpeg(map_, apple_xmp(matrix=LENS), way),
    "GDepth": lambda map_, way: portraits.gdepth_jpeg(png(map_), orientation=way),
    "Dynamic Depth": lambda map_, way: portraits.dynamic_jpeg(png(map_), orientation=way, model=MODEL),
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
    assert (depth.K is None) == ("GDepth" in depth.note)
    if depth.K is None:
        return
    # Each pixel looks along the ray that it had before it was turned, its axes turned alike.
    y, x = np.mgrid[:24, :32].astype(np.float32)
    before = [upright(ray, orientation) for ray in ((x + 0.5 - 10) / 35, (y + 0.5 - 15) / 25)]
    columns, rows = upright(x, orientation), upright(y, orientation)
    v, u = np.mgrid[: depth.depth.shape[0], : depth.depth.shape[1]] + 0.5
    K = depth.K.numpy()
    for axis, ray in ((1, (u - K[0, 2]) / K[0, 0]), (0, (v - K[1, 2]) / K[1, 1])):
        along = np.diff(columns, axis=axis).mean(), np.diff(rows, axis=axis).mean()  # one is ±1, the other 0
        np.testing.assert_allclose(ray, along[0] * before[0] + along[1] * before[1], atol=1e-5)


def extension_of(data: bytes) -> tuple[bytes, list[bytes], bytes]:
    """A JPEG around the segments of its extended XMP, and those."""
    starts = [i - 4 for i in range(len(data)) if data.startswith(b"http://ns.adobe.com/xmp/extension/", i)]
    ends = [start + 2 + struct.unpack(">H", data[start + 2 : start + 4])[0] for start in starts]
    return data[: starts[0]], [data[a:b] for a, b in zip(starts, ends, strict=True)], data[ends[-1] :]


def test_photos_without_depth(tmp_path: Path) -> None:
    other = portraits.jpeg(codes())
    movie = portraits.xmp_segment(portraits.xmp(' GCamera:MotionPhoto="1">', 'xmlns:GCamera="http://ns.google.com/"'))
    gain_map = b"urn:com:apple:photo:2020:aux:hdrgainmap"
    gone = portraits.gdepth_jpeg(png(codes()))  # an editor has dropped the extended XMP
    head, _, tail = extension_of(gone)
    odd = portraits.with_segments(other, portraits.xmp_segment(b"<<<not XML"))
    of_another_picture, link = portraits.heic(codes(), apple_xmp()), b"auxl" + struct.pack(">HHH", 2, 1, 1)
    assert of_another_picture.count(link) == 1
    files = {
        "plain.jpg": portraits.jpeg(picture()),
        "beyond.jpg": portraits.multi_picture(portraits.jpeg(picture()), other, shift=1 << 30),
        "motion.jpg": portraits.with_segments(portraits.jpeg(picture()), movie) + b"\0\0\0\x18ftypmp42" + bytes(99),
        "gone.jpg": head + tail,
        "plain.heic": portraits.heic(None),
        "gain.heic": portraits.heic(codes(), kind=gain_map),
        "gain.xmp.heic": portraits.heic(codes(), apple_xmp(), kind=gain_map),
        "start.jpg": b"\xff\xd8\xff\xe1\xff\xff" + bytes(20),
        "other.txt": b"neither a photo nor anything else",
        "odd.jpg": portraits.multi_picture(odd, odd),
        "other.heic": of_another_picture.replace(link, link[:-1] + b"\3"),
        "broken.heic": portraits.heic(codes()).replace(b"mif1heic\0", b"mif1heic\xff"),  # a box beyond the file
    }
    for name, data in files.items():
        assert load_photo_depth(portraits.write(tmp_path / name, data)) is None, name
    assert load_photo_depth(write_photo(tmp_path / "photo.png")) is None
    for name in ("nowhere.jpg", "empty.jpg"):
        (tmp_path / "empty.jpg").write_bytes(b"")
        with pytest.raises(InputError, match=name):
            load_photo_depth(tmp_path / name)


def test_maps_that_are_damaged_or_do_not_say_what_they_mean(tmp_path: Path) -> None:
    image, apple, dynamic = png(codes()), portraits.apple_jpeg(codes()), portraits.dynamic_jpeg(png(codes()))
    broken, heic = image[:60] + bytes(30) + image[90:], portraits.heic(codes(), apple_xmp())
    uneven = "uneven disparity, 0.25 to 3"
    unsaid = apple_xmp().replace(b"apdi:FloatMaxValue", b"apdi:FloatMiddle")
    empty = apple_xmp().replace(b"<apdi:IntMaxValue>255<", b"<apdi:IntMaxValue>-1<")
    for data, why in (
        (portraits.heic(codes(), information=uneven), "uneven size"),
        (portraits.heic(codes(), information="inverse, 3 to 2 m"), "near 3 and far 2"),
        (portraits.heic(codes(), apple_xmp(ends=("nan", 3))), "'nan' for FloatMinValue, which is not a number"),
        (portraits.apple_jpeg(codes(), apple_xmp(ends=(2, 2))), "announces a disparity from 2 to 2"),
        (portraits.heic(codes(), apple_xmp(ends=(-1e308, 1.1e308))), "no pixel with a depth|makes no sense"),
        (portraits.apple_jpeg(codes(), apple_xmp(ends=(1e-320, 1e-310))), "no pixel with a depth"),
        (portraits.apple_jpeg(codes(), unsaid), "does not say its range"),
        (portraits.apple_jpeg(codes(), empty), "a number of its range makes no sense"),
        (portraits.gdepth_jpeg(b"", text="****"), "cannot be decoded"),
        (portraits.gdepth_jpeg(broken), "cannot be decoded"),
        (portraits.dynamic_jpeg(broken), "cannot be decoded"),
        (portraits.gdepth_jpeg(b"GIF89a" + image), "cannot be decoded"),
        (apple[:-20], "is cut off: the file ends before it does"),
        (heic[: heic.rindex(b"mdat") + 40], "cannot be decoded|cannot be read"),
        (dynamic[:-20], "is cut off, or not where"),
        (portraits.dynamic_jpeg(image, length=-5), "negative length"),
        (dynamic.replace(b'DepthURI="android/depthmap"', b'DepthURI="android/deepmap1"'), "photo's directory"),
        (dynamic.replace(b'Item:Length="0"', b'Item:Length="x"'), "'x' for Length"),
    ):
        refused(tmp_path, data, why)
    same(found(tmp_path, portraits.heic(codes(), apple_xmp(), information=uneven)), between(0.5, 3))
    assert "assumed" in found(tmp_path, portraits.heic(codes(), unsaid)).note


@pytest.mark.parametrize(
    ("image", "why"),
    [
        *((np.full((24, 32), flat, np.uint8), "the same value everywhere") for flat in (0, 7, 255)),
        (codes(32, 32), "has 32×32 pixels but the photo 64×48, another crop"),
    ],
)
def test_a_map_with_one_value_or_of_another_crop_is_refused(tmp_path: Path, image: NDArray[Any], why: str) -> None:
    gdepth, dynamic = portraits.gdepth_jpeg(png(image)), portraits.dynamic_jpeg(png(image))
    for data in (portraits.heic(image, apple_xmp()), portraits.apple_jpeg(image), gdepth, dynamic):
        refused(tmp_path, data, why)
    found(tmp_path, portraits.gdepth_jpeg(png(codes(133, 100))))  # within 1 %


@each_of_android
@pytest.mark.parametrize(
    ("said", "why"),
    [
        (Range(8, 0.5), "near 8 and far 0.5"),
        (Range("nan", 3), "'nan' for Near"),
        (Range(5e-324, 3), "makes no sense"),
        (Range(1e300, 1e305), "no pixel with a depth"),
        (Range(style="RangeSquared"), "the format 'rangesquared'"),
    ],
)
def test_androids_ranges_that_mean_nothing(tmp_path: Path, make: Callable[..., bytes], said: Range, why: str) -> None:
    refused(tmp_path, make(png(codes()), said), why)
    data = make(png(codes()), Range(near=0.123))
    for missing in (b":Near", b":Format"):
        refused(tmp_path, data.replace(missing, missing[:2] + b"x" * (len(missing) - 2)), "missing|the format ''")


def test_extended_xmp_with_missing_mixed_and_foreign_parts(tmp_path: Path) -> None:
    data = portraits.gdepth_jpeg(png(codes()), part=100)
    expected = found(tmp_path, data).depth
    head, parts, tail = extension_of(data)
    assert len(parts) > 4
    assert torch.equal(found(tmp_path, head + b"".join(reversed(parts)) + tail).depth, expected)
    foreign = parts[0].replace(parts[0][39:71], b"0" * 32)
    assert torch.equal(found(tmp_path, head + foreign + b"".join(parts) + tail).depth, expected)
    for kept in (parts[1:], parts[:-1], parts[:2] + parts[3:], [*parts, parts[1]]):
        refused(tmp_path, head + b"".join(kept) + tail, "extended XMP is missing")
    longer = [part[:71] + struct.pack(">I", 1 << 31) + part[75:] for part in parts]
    refused(tmp_path, head + b"".join(longer) + tail, "extended XMP is missing")


@pytest.mark.parametrize(
    ("hostile", "why"),
    [
        (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "document type"),
        ('<?xml version="1.0" encoding="utf-16"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'.encode("utf-16"), "XMP"),
        (b"<a>" * 45_000 + b"</a>" * 45_000, "too large"),
        (b"<a>" + b"<b/>" * 45_000 + b"</a>", "too large"),
        (b"<a><b></a>", "cannot be read"),
        (b"", "cannot be read"),
    ],
)
def test_hostile_xmp(tmp_path: Path, hostile: bytes, why: str) -> None:
    """Wherever it stands; a namespace in a comment makes it look like depth."""
    google = hostile + b"<!-- http://ns.google.com/photos/1.0/depthmap/ -->"
    digest, parts = portraits.extended_segments(google, 60_000)
    named = portraits.xmp(f' xmpNote:HasExtendedXMP="{digest}">', portraits.GDEPTH)
    photo = portraits.jpeg(picture())
    refused(tmp_path, portraits.with_segments(photo, portraits.xmp_segment(named), *parts), why)
    if len(hostile) < 60_000:
        refused(tmp_path, portraits.with_segments(photo, portraits.xmp_segment(google)), why)
        packet = hostile + b"<!-- http://ns.apple.com/pixeldatainfo/1.0/ -->"
        refused(tmp_path, portraits.apple_jpeg(codes(), packet), why)


def test_huge_announced_sizes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small(width: int, height: int, size: int, path: str) -> None:
        if width * height > 700:
            raise InputError(f"{path}: {width}×{height} is too large")

    monkeypatch.setattr(layouts, "check_pixels", small)
    google = portraits.gdepth_jpeg(png(codes())), portraits.dynamic_jpeg(png(codes()))
    for data in (*google, portraits.apple_jpeg(codes()), portraits.heic(codes())):
        refused(tmp_path, data, "32×24 is too large")


def test_nothing_in_a_file_makes_the_search_endless(tmp_path: Path) -> None:
    start = time.process_time()
    fill = b"\xff\xd8\xff" + b"\xff" * 300_000
    tiny = b"\xff\xd8" + b"\xff\xe5\x00\x02" * 100_000
    scans = portraits.dynamic_jpeg(png(codes())).replace(b"\xff\xd9", b"\xff\xda\x00\x02" * 500_000)
    packets = portraits.heic(codes(), b"<x:xmpmeta" * 300_000)
    for data in (fill, tiny, scans, packets):
        with contextlib.suppress(InputError):
            load_photo_depth(portraits.write(tmp_path / "slow.jpg", data))
    assert time.process_time() - start < 5
