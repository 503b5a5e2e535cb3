"""Photos: formats, orientation, colours, focal length, and files that are no photos."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.photo_files import jpeg, jpeg_of_scans
from PIL import Image, ImageCms, ImageOps, TiffImagePlugin

from spackle.core.focal_length import FocalSource, focal_from_exif, focal_mm_to_px
from spackle.core.image_files import count_scans
from spackle.core.photo import load_photo, replace_border, resize_photo, working_size
from spackle.runtime.errors import InputError


def picture(width: int = 48, height: int = 32) -> Image.Image:
    """A smooth picture without symmetry."""
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    rgb = np.stack([x, y, 0.3 + 0.5 * x * y], axis=-1)
    return Image.fromarray((rgb * 255).astype(np.uint8))


TAGS = {"focal": 0x920A, "film": 0xA405, "pixel_x": 0xA002, "plane_x": 0xA20E, "plane_unit": 0xA210}


def exif(orientation: int = 1, **tags: Any) -> bytes:
    result = Image.Exif()
    result[0x0112] = orientation
    result.get_ifd(0x8769).update({TAGS[name]: value for name, value in tags.items()})
    return result.tobytes()


def unit(image: Image.Image) -> torch.Tensor:
    return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255


TURNED = [
    *(("jpg", orientation) for orientation in range(1, 9)),
    ("png", 6),
    ("webp", 5),
    ("tiff", 7),
    ("heic", 6),
]


@pytest.mark.parametrize(("suffix", "orientation"), [*TURNED, ("bmp", 1)])
def test_common_formats_are_read_upright(tmp_path: Path, suffix: str, orientation: int) -> None:
    path, turned = tmp_path / f"photo.{suffix}", picture(64, 32)
    tags = {} if suffix == "bmp" else {"exif": exif(orientation, film=26)}
    turned.save(path, **tags, **({"lossless": True} if suffix == "webp" else {"quality": 95}))
    turned.getexif()[0x0112] = orientation
    photo = load_photo(path)
    assert (photo.rgb.dtype, photo.path) == (torch.float32, path)
    expected = unit(ImageOps.exif_transpose(turned))
    assert (photo.rgb - expected).abs().max() < (0.06 if suffix in ("jpg", "heic") else 1e-6)
    if suffix not in ("tiff", "bmp"):  # Pillow writes no EXIF directory into these formats
        assert (photo.focal_source, photo.focal_px) == (
            FocalSource.EXIF,
            pytest.approx(focal_mm_to_px(26, 64, 32)),
        )


def test_modes(tmp_path: Path) -> None:
    grey = np.linspace(0, 65535, 48 * 32).reshape(32, 48).astype(np.uint16)
    for name in ("deep.png", "deep.tiff"):
        Image.fromarray(grey).save(tmp_path / name)
        assert abs(load_photo(tmp_path / name).rgb[..., 1].numpy() - grey / 65535).max() < 1e-6
    for mode, name in {
        "L": "a.png",
        "1": "a.png",
        "P": "a.png",
        "CMYK": "a.jpg",
        "YCbCr": "a.jpg",
    }.items():
        picture().convert(mode).save(tmp_path / name, quality=95)
        off = (load_photo(tmp_path / name).rgb - unit(picture().convert(mode))).abs().max()
        assert off < (0.06 if name == "a.jpg" else 1e-6), mode
    frames = [Image.new("RGB", (8, 8), color) for color in ("red", "blue")]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    assert load_photo(tmp_path / "a.gif").rgb[0, 0].tolist() == [1, 0, 0]


def test_transparency_lies_over_white(tmp_path: Path) -> None:
    image = Image.new("RGBA", (4, 2), (255, 0, 0, 255))
    image.putpixel((0, 0), (0, 0, 0, 0))
    image.putpixel((1, 0), (0, 0, 0, 128))
    image.save(tmp_path / "a.png")
    rgb = load_photo(tmp_path / "a.png").rgb
    assert (rgb[0, 0].tolist(), rgb[1, 3].tolist()) == ([1, 1, 1], [1, 0, 0])
    assert float(rgb[0, 1, 0]) == pytest.approx(127 / 255)


def test_colour_profile(tmp_path: Path) -> None:
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile in (srgb, b"not a profile at all"):
        picture().save(tmp_path / "a.png", icc_profile=profile)
        assert torch.equal(load_photo(tmp_path / "a.png").rgb, unit(picture()))
    # A profile whose red and green are exchanged.
    swapped = srgb.replace(b"rXYZ", b"tmp0").replace(b"gXYZ", b"rXYZ").replace(b"tmp0", b"gXYZ")
    swapped = swapped.replace("sRGB".encode("utf-16-be"), "test".encode("utf-16-be"))
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "a.png", icc_profile=swapped)
    assert load_photo(tmp_path / "a.png").rgb[0, 0].tolist() == pytest.approx([0, 1, 0], abs=0.03)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"film": 26, "focal": 4.2}, focal_mm_to_px(26, 480, 320)),
        ({"film": 0, "focal": 50.0}, focal_mm_to_px(50, 480, 320)),
        ({"focal": 4.0}, focal_mm_to_px(4.0 * 8.4, 480, 320)),
        ({"focal": 35.0, "plane_x": 2000.0, "plane_unit": 3, "pixel_x": 4800}, 35 * 200 / 10),
        (
            {"focal": 50.0, "plane_x": 1e9},
            focal_mm_to_px(50, 480, 320),
        ),  # an absurd pixel pitch is ignored
        ({"film": 65535}, None),
        ({"focal": TiffImagePlugin.IFDRational(1, 0)}, None),
        ({}, None),
    ],
)
def test_focal_from_exif(tmp_path: Path, tags: dict[str, Any], expected: float | None) -> None:
    picture(480, 320).save(tmp_path / "a.jpg", exif=exif(**tags))
    photo = load_photo(tmp_path / "a.jpg")
    assert photo.focal_source == (FocalSource.EXIF if expected else FocalSource.ASSUMED)
    assert photo.focal_px == pytest.approx(expected or focal_mm_to_px(30, 480, 320), rel=1e-4)


@pytest.mark.parametrize("value", ["4.2 mm", None, -1, math.nan, 10**400])
def test_nonsense_in_exif_is_no_focal_length(value: object) -> None:
    assert (
        focal_from_exif(dict.fromkeys([0x920A, 0xA405, 0xA002, 0xA20E, 0xA210], value), 480, 320)
        is None
    )


@pytest.mark.parametrize(
    ("option", "value", "focal"),
    [
        ("focal_px", 500, 500),
        ("focal_mm", 50, 50 * math.hypot(480, 320) / math.hypot(36, 24)),
        ("fov", 90, 240),
    ],
)
def test_given_focal_lengths(tmp_path: Path, option: str, value: float, focal: float) -> None:
    picture(480, 320).save(path := tmp_path / "a.png")
    photo = load_photo(path, **{option: value})  # type: ignore[arg-type]
    assert (photo.focal_source, photo.focal_px) == (
        FocalSource(option),
        pytest.approx(focal),
    )
    assert photo.camera.focal == pytest.approx((focal, focal))
    assert photo.camera.K[:2, 2].tolist() == [240, 160]
    nonsense: list[dict[str, float]] = [{option: wrong} for wrong in (0, -1, math.nan, math.inf)]
    for given in (*nonsense, {"fov": 180.0}, {"fov": 60.0, "focal_mm": 30.0}):
        with pytest.raises(InputError, match="`f"):
            load_photo(path, **given)  # type: ignore[arg-type]


def test_resize(tmp_path: Path) -> None:
    picture(300, 199).save(tmp_path / "a.png")
    photo = load_photo(tmp_path / "a.png", focal_px=150)
    small = resize_photo(photo, 100)
    assert (small.rgb.shape, small.focal_px) == ((66, 100, 3), pytest.approx(50))
    with Image.open(tmp_path / "a.png") as image:
        expected = unit(image.resize((100, 66), Image.Resampling.LANCZOS))
    assert (small.rgb - expected).abs().max() < 2 / 255
    assert resize_photo(photo) is photo
    assert [working_size(9000, 1, 100), working_size(3, 5000, 1000)] == [(100, 1), (1, 1000)]


def test_pad_edge_replaces_the_outermost_pixels() -> None:
    photo = torch.full((100, 400, 3), 0.5)
    photo[:, -2:], photo[0] = 1.0, 0.0
    assert (replace_border(photo) == 0.5).all()
    photo[2:-2, 2:-2] = torch.rand(96, 396, 3)
    assert (replace_border(photo)[2:-2, 2:-2] == photo[2:-2, 2:-2]).all()
    assert replace_border(photo[:3, :1]).shape == (3, 1, 3)


def png_claiming(width: int, height: int) -> bytes:
    """A tiny PNG whose header claims this size."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + chunk + b"\x00\x00\x00\x00IEND\xaeB`\x82"


def encoded(suffix: str, pixels: Any) -> bytes:
    Image.fromarray(pixels).save(buffer := io.BytesIO(), suffix)
    return buffer.getvalue()


NOISE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "no such photo"),
        (b"", "empty"),
        (b"hello, I am a text file\n", "not an image"),
        (encoded("TIFF", np.zeros((4, 4), np.float32)), "32 bits"),
        (encoded("PNG", NOISE)[:600], "damaged or cut off"),
        (encoded("JPEG", NOISE)[:600], "damaged or cut off"),
        (png_claiming(11_000, 10_000), r"110 megapixels \(11000×10000\) are too large"),
        (png_claiming(100_000, 100_000), "megapixels"),
    ],
)
def test_bad_files(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "bad.jpg"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        load_photo(path)
    assert str(path) in str(caught.value)


def test_a_jpeg_of_thousands_of_scans_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "scans.jpg"
    path.write_bytes(jpeg_of_scans(20_000))
    with pytest.raises(InputError, match=r"scans\.jpg: cannot be decoded \(it has 20\d{3} scans"):
        load_photo(path)


def test_the_scans_of_a_jpeg_are_those_of_its_own_picture_alone() -> None:
    pixels = np.asarray(picture(200, 100))
    assert count_scans(jpeg(pixels)) == 1
    progressive = jpeg(pixels, progressive=True)
    # Pillow's library writes ten scans of a colour picture.
    assert count_scans(progressive) == 10
    # Neither a preview in its tags nor what follows its end counts.
    with_preview = jpeg(pixels, exif=exif() + progressive)
    assert count_scans(with_preview + progressive) == 1
    assert count_scans(b"\xff\xd8\xff\xda") == 1
    assert count_scans(b"") == 0
