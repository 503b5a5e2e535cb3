"""Photos: formats, orientation, focal length, and everything that is not a photo."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
import torch
from PIL import Image, ImageCms, ImageOps, TiffImagePlugin

from spackle.errors import InputError
from spackle.image import film_to_pixels, focal_from_exif, load_photo, resize_photo, working_size


def picture(width: int = 48, height: int = 32) -> Image.Image:
    """A smooth picture without any symmetry."""
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    rgb = np.stack([x, y, 0.3 + 0.5 * x * y], axis=-1)
    return Image.fromarray((rgb * 255).astype(np.uint8))


def exif(**tags: Any) -> Image.Exif:
    numbers = {"orientation": 0x0112}
    inner = {"focal": 0x920A, "film": 0xA405, "pixel_x": 0xA002, "plane_x": 0xA20E, "plane_unit": 0xA210}
    result = Image.Exif()
    for name, value in tags.items():
        if name in numbers:
            result[numbers[name]] = value
        else:
            result.get_ifd(0x8769)[inner[name]] = value
    return result


def unit(image: Image.Image) -> torch.Tensor:
    return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255


@pytest.mark.parametrize("suffix", ["png", "webp", "tiff", "bmp", "jpg", "heic"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_usual_formats_are_read_upright(tmp_path: Path, orientation: int, suffix: str) -> None:
    pillow_heif.register_heif_opener()
    path, turned = tmp_path / f"photo.{suffix}", picture(64, 32)
    tags = {} if suffix == "bmp" else {"exif": exif(orientation=orientation, film=26).tobytes()}
    turned.save(path, **tags, **({"lossless": True} if suffix == "webp" else {"quality": 95}))
    turned.getexif()[0x0112] = orientation if tags else 1
    photo = load_photo(path)
    assert (photo.rgb.dtype, photo.path) == (torch.float32, path)
    expected = unit(ImageOps.exif_transpose(turned))
    assert (photo.rgb - expected).abs().max() < (0.06 if suffix in ("jpg", "heic") else 1e-6)
    if suffix != "heic":  # which its decoder turns
        with Image.open(path) as image:
            assert torch.equal(photo.rgb, unit(ImageOps.exif_transpose(image)))
    if suffix not in ("tiff", "bmp"):  # Pillow writes no EXIF directory there
        assert photo.focal_source == "EXIF"
        assert photo.focal_px == pytest.approx(film_to_pixels(26, 64, 32))


def test_modes(tmp_path: Path) -> None:
    grey = np.linspace(0, 65535, 48 * 32).reshape(32, 48).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "deep.png")
    deep = load_photo(tmp_path / "deep.png").rgb
    assert (deep[..., 1].numpy() - grey / 65535).max() < 1e-6
    Image.fromarray(grey).save(tmp_path / "deep.tiff")
    assert torch.equal(load_photo(tmp_path / "deep.tiff").rgb, deep)

    for mode, tolerance in {"L": 1e-6, "1": 1e-6, "P": 1e-6, "CMYK": 0.06, "YCbCr": 0.06}.items():
        converted = picture().convert(mode)
        path = tmp_path / f"{mode}.{'jpg' if mode in ('CMYK', 'YCbCr') else 'png'}"
        converted.save(path, quality=95) if path.suffix == ".jpg" else converted.save(path)
        assert (load_photo(path).rgb - unit(converted)).abs().max() < tolerance, mode
    frames = [Image.new("RGB", (8, 8), color) for color in ("red", "blue")]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    assert load_photo(tmp_path / "a.gif").rgb[0, 0].tolist() == [1, 0, 0]  # the first one


def test_transparency_lies_over_white(tmp_path: Path) -> None:
    image = Image.new("RGBA", (4, 2), (255, 0, 0, 255))
    image.putpixel((0, 0), (0, 0, 0, 0))
    image.putpixel((1, 0), (0, 0, 0, 128))
    image.save(tmp_path / "a.png")
    rgb = load_photo(tmp_path / "a.png").rgb
    assert rgb[0, 0].tolist() == [1, 1, 1]
    assert rgb[0, 1, 0] == pytest.approx(127 / 255)
    assert rgb[1, 3].tolist() == [1, 0, 0]
    palette = Image.new("P", (4, 2), 0)
    palette.putpalette([10, 20, 30, 200, 100, 50])
    palette.putpixel((2, 1), 1)
    palette.save(tmp_path / "p.png", transparency=0)
    rgb = load_photo(tmp_path / "p.png").rgb
    assert rgb[0, 0].tolist() == [1, 1, 1]
    assert (rgb[1, 2] * 255).tolist() == pytest.approx([200, 100, 50])


def test_colour_profile(tmp_path: Path) -> None:
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    picture().save(tmp_path / "same.png", icc_profile=lab.tobytes())
    assert torch.equal(load_photo(tmp_path / "same.png").rgb, unit(picture()))
    picture().save(tmp_path / "broken.png", icc_profile=b"not a profile at all")
    assert torch.equal(load_photo(tmp_path / "broken.png").rgb, unit(picture()))
    # A profile whose red and green are exchanged: the primaries' tags trade their names.
    swapped = lab.tobytes().replace(b"rXYZ", b"tmp0").replace(b"gXYZ", b"rXYZ").replace(b"tmp0", b"gXYZ")
    swapped = swapped.replace("sRGB".encode("utf-16-be"), "test".encode("utf-16-be"))
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "swapped.png", icc_profile=swapped)
    assert load_photo(tmp_path / "swapped.png").rgb[0, 0].tolist() == pytest.approx([0, 1, 0], abs=0.03)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"film": 26, "focal": 4.2}, film_to_pixels(26, 480, 320)),
        ({"film": 0, "focal": 50.0}, film_to_pixels(50, 480, 320)),
        ({"focal": 4.0}, film_to_pixels(4.0 * 8.4, 480, 320)),
        ({"focal": 35.0, "plane_x": 2000.0, "plane_unit": 3, "pixel_x": 4800}, 35 * 200 / 10),
        ({"focal": 50.0, "plane_x": 1e9}, film_to_pixels(50, 480, 320)),  # absurd pitch: passed over
        ({"film": 65535}, None),
        ({"focal": TiffImagePlugin.IFDRational(1, 0)}, None),
        ({}, None),
    ],
)
def test_focal_from_exif(tmp_path: Path, tags: dict[str, Any], expected: float | None) -> None:
    picture(480, 320).save(tmp_path / "a.jpg", exif=exif(**tags))
    photo = load_photo(tmp_path / "a.jpg")
    assert photo.focal_source == ("EXIF" if expected else "default 30 mm")
    assert photo.focal_px == pytest.approx(expected or film_to_pixels(30, 480, 320), rel=1e-4)


@pytest.mark.parametrize("value", ["", "4.2 mm", b"\0\0", None, (1, 2), -1, math.nan, math.inf, 10**400])
def test_nonsense_in_exif_is_no_focal_length(value: object) -> None:
    assert focal_from_exif(dict.fromkeys([0x920A, 0xA405, 0xA002, 0xA20E, 0xA210], value), 480, 320) is None


def test_given_focal_lengths(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    picture(480, 320).save(path)
    assert load_photo(path, focal_px=500).focal_px == 500
    by_mm = load_photo(path, focal_mm=50)
    assert by_mm.focal_px == pytest.approx(50 * math.hypot(480, 320) / math.hypot(36, 24))
    by_fov = load_photo(path, fov=90)
    assert by_fov.focal_px == pytest.approx(240)
    assert [p.focal_source for p in (by_mm, by_fov)] == ["--focal-mm", "--fov"]
    assert by_fov.camera.focal == pytest.approx((240, 240))
    assert by_fov.camera.K[:2, 2].tolist() == [240, 160]
    nonsense: list[dict[str, float]] = [{"focal_px": v} for v in (0, -1, math.nan, math.inf)]
    nonsense += [{"focal_mm": 0}, {"fov": 0}, {"fov": 180}, {"fov": math.nan}, {"fov": 60, "focal_mm": 30}]
    for given_focal in nonsense:
        with pytest.raises(InputError, match="--f"):
            load_photo(path, **given_focal)  # type: ignore[arg-type]


def test_resize(tmp_path: Path) -> None:
    picture(300, 199).save(tmp_path / "a.png")
    photo = load_photo(tmp_path / "a.png", focal_px=150)
    small = resize_photo(photo, 100)
    assert small.rgb.shape == (66, 100, 3)
    assert small.focal_px == pytest.approx(50)
    with Image.open(tmp_path / "a.png") as image:
        expected = unit(image.resize((100, 66), Image.Resampling.LANCZOS))
    assert (small.rgb - expected).abs().max() < 2 / 255
    assert resize_photo(photo) is photo
    assert [working_size(9000, 1, 100), working_size(3, 5000, 1000)] == [(100, 1), (1, 1000)]


def png_claiming(width: int, height: int) -> bytes:
    """A tiny PNG whose header claims a size."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + chunk + b"\x00\x00\x00\x00IEND\xaeB`\x82"


def encoded(suffix: str) -> bytes:
    pillow_heif.register_heif_opener()
    buffer = io.BytesIO()
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(buffer, suffix)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty"),
        (b"hello, I am a text file\n", "not an image"),
        (encoded("PNG")[:600], "damaged or cut off"),
        (encoded("JPEG")[:600], "damaged or cut off"),
        (encoded("HEIF")[:600], "damaged|not an image"),
        (png_claiming(11_000, 10_000), "11000×10000 is too large"),
        (png_claiming(100_000, 100_000), "megapixels"),
    ],
)
def test_bad_files(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "bad.jpg"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        load_photo(path)
    assert str(path) in str(caught.value)


def test_missing_and_odd_paths(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.zeros((3, 3)))
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "hdr.tiff")
    for name, says in (
        ("none.jpg", "no such photo"),
        (".", "not a plain file"),
        ("a\0b", "null byte|no such"),
        ("array.npy", "not an image"),
        ("hdr.tiff", "32 bits"),
    ):
        with pytest.raises(InputError, match=says):
            load_photo(tmp_path / name)
