"""Photos as people bring them: any suffix, several pictures, raw files, panoramas, no photos."""

from __future__ import annotations

import ast
import io
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.photo_files import (
    CODES_OF_KINDS,
    TiffFile,
    av1_item,
    exif,
    gpano,
    item_file,
    jpeg,
    nclx,
    picture_tags,
    raw_file,
    squares,
)
from PIL import Image, PngImagePlugin

import spackle
from spackle.core.focal_length import FocalSource
from spackle.core.image_files import read_image
from spackle.core.image_formats import PHOTO_SUFFIXES, kind_of_bytes, list_photos
from spackle.core.photo import MAYBE_360_NOTE, load_photo, photo_from_picture
from spackle.runtime.errors import InputError

SOURCES = Path(spackle.__file__).parent


def picture(width: int = 64, height: int = 48) -> np.ndarray:
    """A smooth picture without symmetry, [H, W, 3]."""
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    return (np.stack([x, y, 0.3 + 0.5 * x * y], axis=-1) * 255).astype(np.uint8)


def encoded(kind: str, pixels: np.ndarray | None = None, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture() if pixels is None else pixels).save(file, kind, **options)
    return file.getvalue()


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


# --- Formats


FORMATS = ("JPEG", "PNG", "WebP", "HEIF", "AVIF", "TIFF", "GIF", "BMP", "PPM")


@pytest.mark.parametrize("kind", FORMATS)
def test_the_content_decides_the_format_and_no_name_does(tmp_path: Path, kind: str) -> None:
    content = encoded(kind.upper())
    for name in ("a", "b.jpg", "c.png", "d.xyz"):
        photo = load_photo(written(tmp_path / name, content))
        assert (photo.width, photo.height, photo.notes) == (64, 48, ())


@pytest.mark.parametrize(("name", "content"), CODES_OF_KINDS.items())
def test_other_files_are_refused_by_what_they_are(
    tmp_path: Path, name: str, content: bytes
) -> None:
    path = written(tmp_path / "photo.jpg", content + bytes(200))
    with pytest.raises(InputError, match=name) as caught:
        load_photo(path)
    assert str(path) in str(caught.value)
    assert not kind_of_bytes(content).is_photo


def test_the_photos_of_a_folder_are_told_by_content_and_the_others_are_named(
    tmp_path: Path,
) -> None:
    photos = {
        "a.jpg": "JPEG", "b.jfif": "JPEG", "c.jpe": "JPEG", "d.avif": "AVIF", "e.HIF": "HEIF",
        "f.bmp": "BMP", "g.PNG": "PNG", "h.ppm": "PPM", "i.gif": "GIF", "no suffix": "JPEG",
        "j.txt": "WEBP", "k.mpo": "JPEG",
    }  # fmt: skip
    for name, kind in photos.items():
        written(tmp_path / name, encoded(kind))
    others = ("notes.txt", "depth.npy", "clip.mp4", "z.psd")
    for name in others:
        written(tmp_path / name, b"\x93NUMPY" if name == "depth.npy" else b"anything else")
    written(tmp_path / "._a.jpg", b"\0\5\x16\7")  # hidden
    written(tmp_path / "map.pfm", b"Pf\n1 1\n-1\n\0\0\0\0")  # a depth map
    lines: list[str] = []
    assert {path.name for path in list_photos(tmp_path, log=lines.append)} == set(photos)
    (line,) = lines
    assert str(tmp_path) in line
    assert (
        "5 files are no photos, and are left out: clip.mp4, depth.npy, map.pfm and 2 more" in line
    )


def test_a_damaged_photo_stays_in_the_list_so_that_it_is_named(tmp_path: Path) -> None:
    written(tmp_path / "a.jpg", b"nothing")
    assert [path.name for path in list_photos(tmp_path)] == ["a.jpg"]
    (tmp_path / "below").mkdir()
    written(tmp_path / "below" / "b", encoded("PNG"))
    assert len(list_photos(tmp_path, below=True)) == 2


def test_every_suffix_that_pillow_gives_a_format_of_photos_is_a_photos_suffix() -> None:
    Image.init()
    kinds = {"JPEG", "PNG", "WEBP", "HEIF", "AVIF", "TIFF", "GIF", "BMP", "PPM"}
    of_pillow = {suffix for suffix, kind in Image.registered_extensions().items() if kind in kinds}
    assert of_pillow - {".pfm"} <= set(PHOTO_SUFFIXES)


# --- Decoders


def test_postscript_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = tmp_path / "started"
    program = written(tmp_path / "gs", f"#!/bin/sh\ntouch {started}\nexit 1\n".encode())
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)  # looks for the program again
    drawing = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\nshowpage\n%%EOF\n"
    path = written(tmp_path / "photo.jpg", drawing)
    for read in (load_photo, lambda path: read_image(path, lambda image: image.load())):
        with pytest.raises(InputError, match="a PostScript file"):
            read(path)
    with pytest.raises(InputError, match="PostScript"):
        spackle.predict(drawing)
    assert not started.exists()


def test_pillow_opens_files_in_one_place_and_only_formats_that_are_named() -> None:
    opened = []
    for path in SOURCES.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Image.open"):
                opened.append((path.name, {keyword.arg for keyword in node.keywords}))
    assert opened == [("image_files.py", {"formats"})]


# --- Several pictures


SEVERAL = {  # what a line says; the further pictures of a JPEG are for other purposes
    "GIF, animated": "the file is animated, and its first picture is used",
    "WebP, animated": "the file is animated, and its first picture is used",
    "PNG, animated": "the file is animated, and its first picture is used",
    "TIFF, several pictures": "the file has 2 pictures, and the first one is used",
    "AVIF, animated": "the file is animated, and its still picture is used",
    "HEIF, several pictures": "the file has 2 pictures, and the main one is used",
    "JPEG, several pictures": None,
}


@pytest.mark.parametrize("name", SEVERAL)
def test_of_several_pictures_the_main_one_is_used_and_said(tmp_path: Path, name: str) -> None:
    kind = name.partition(",")[0].upper().replace("JPEG", "MPO")
    file = io.BytesIO()
    Image.fromarray(picture()).save(
        file, kind, save_all=True, append_images=[Image.new("RGB", (64, 48), "blue")], quality=95
    )
    photo = load_photo(written(tmp_path / "a", file.getvalue()))
    assert photo.notes == (() if SEVERAL[name] is None else (SEVERAL[name],))
    assert abs(photo.rgb.numpy() * 255 - picture()).max() < 40


def test_each_format_on_the_page_is_read_in_a_test() -> None:
    page = (Path(__file__).parents[2] / "docs" / "inputs.md").read_text(encoding="utf-8")
    section = page.split("## Photos")[1].split("### Colours")[0]
    cells = re.findall(r"^\|.*\| ([^|]+) \|$", section, re.MULTILINE)
    named = {name.strip() for cell in cells for name in cell.split(";")} - {"kinds", "---"}
    assert named == {*FORMATS, *SEVERAL, "raw"}


def test_the_primary_item_is_used_wherever_it_stands(tmp_path: Path) -> None:
    blue = np.full((64, 96, 3), [0.1, 0.1, 0.9])
    green = np.full((64, 64, 3), [0.1, 0.9, 0.1])
    items = [
        (b"av01", content, [*properties, nclx(1, 13, 9)])
        for content, properties in map(av1_item, (blue, green))
    ]
    photo = load_photo(written(tmp_path / "a.avif", item_file(items, primary=2)))
    assert photo.width == 64
    assert photo.rgb.mean(dim=(0, 1)).tolist() == pytest.approx([0.1, 0.9, 0.1], abs=0.02)
    assert photo.notes == ("the file has 2 pictures, and the main one is used",)
    # A thumbnail is no picture of its own.
    thumbnail = item_file(items, primary=2, references=[(b"thmb", 1, [2])])
    assert load_photo(written(tmp_path / "a.avif", thumbnail)).notes == ()


def test_a_file_whose_picture_has_another_size_than_it_says_is_refused(tmp_path: Path) -> None:
    heic = encoded("HEIF")
    place = heic.index(b"ispe") + 8  # behind the name, the version and the flags
    wrong = heic[:place] + struct.pack(">II", 4032, 3024) + heic[place + 8 :]
    with pytest.raises(InputError, match=r"a\.heic"):
        load_photo(written(tmp_path / "a.heic", wrong))


def test_a_thumbnail_that_comes_first_in_a_tiff_is_not_the_photo(tmp_path: Path) -> None:
    file = TiffFile()
    large = file.add_directory(picture_tags(file, picture()))
    small = picture_tags(file, picture(16, 12), reduced=True)
    content = file.begin_with(file.add_directory(small, following=large))
    photo = load_photo(written(tmp_path / "a.tif", content))
    assert (photo.width, photo.height, photo.notes) == (64, 48, ())
    assert abs(photo.rgb.numpy() * 255 - picture()).max() < 1e-3


def test_the_codes_of_twelve_bits_fill_the_range(tmp_path: Path) -> None:
    grey = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64) % 4096
    pairs = grey.reshape(48, 32, 2).astype(np.uint32)
    packed = np.stack(
        [pairs[..., 0] >> 4, (pairs[..., 0] & 15) << 4 | pairs[..., 1] >> 8, pairs[..., 1] & 255],
        axis=-1,
    ).astype(np.uint8)
    file = TiffFile()
    tags = picture_tags(file, grey, photometric=1)
    tags |= {258: (3, [12]), 273: (4, [file.add(packed.tobytes())]), 279: (4, [packed.size])}
    photo = load_photo(written(tmp_path / "a.tif", file.begin_with(file.add_directory(tags))))
    assert abs(photo.rgb[..., 0].numpy() - grey / 4095).max() < 1e-4


# --- Raw files

LARGE = picture(1200, 900)
THUMBNAIL = picture(160, 120)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("layout", ["subifd", "strip", "maker"])
def test_the_large_preview_of_a_raw_file_is_used(tmp_path: Path, layout: str, order: str) -> None:
    content = raw_file(THUMBNAIL, jpeg(LARGE), (40, 30), layout=layout, order=order)
    photo = load_photo(written(tmp_path / "a.nef", content))
    assert (photo.width, photo.height) == (1200, 900)
    assert abs(photo.rgb.numpy() * 255 - LARGE).max() < 20
    assert photo.notes == ("a raw file, of which the camera's preview of 1200×900 pixels is used",)
    assert photo.focal_source is FocalSource.EXIF  # of the raw file: the preview has none


def test_a_preview_without_compression_is_used(tmp_path: Path) -> None:
    content = raw_file(THUMBNAIL, LARGE, (40, 30), orientation=6)
    photo = load_photo(written(tmp_path / "a.dng", content))
    assert (photo.rgb.numpy() * 255 == np.rot90(LARGE, -1)).all()


@pytest.mark.parametrize(("outer", "inner", "turned"), [(6, None, 6), (6, 8, 8), (1, None, 1)])
def test_a_preview_is_turned_by_its_own_orientation_or_that_of_the_raw_file(
    tmp_path: Path, outer: int, inner: int | None, turned: int
) -> None:
    options = {} if inner is None else {"exif": exif({0x0112: inner})}
    content = raw_file(THUMBNAIL, jpeg(LARGE, **options), (40, 30), orientation=outer)
    photo = load_photo(written(tmp_path / "a.cr2", content))
    expected = np.rot90(LARGE, {1: 0, 6: -1, 8: 1}[turned])
    assert photo.rgb.shape == expected.shape
    assert abs(photo.rgb.numpy() * 255 - expected).max() < 20


@pytest.mark.parametrize(
    ("sensor", "preview", "used"),
    [
        ((640, 480), (256, 192), False),
        ((640, 480), (320, 240), True),  # half of the sensor's
        ((6000, 40), (1024, 768), True),
        ((6000, 40), (1000, 750), False),
    ],
)
def test_a_small_preview_is_refused(
    tmp_path: Path, sensor: tuple[int, int], preview: tuple[int, int], used: bool
) -> None:
    path = written(
        tmp_path / "a.dng", raw_file(THUMBNAIL[::4, ::4], jpeg(picture(*preview)), sensor)
    )
    if used:
        assert load_photo(path).width == preview[0]
        return
    with pytest.raises(InputError, match="export a JPEG") as caught:
        load_photo(path)
    assert f"{preview[0]}×{preview[1]}" in str(caught.value)
    assert str(path) in str(caught.value)


def test_raw_files_that_are_no_tiff_are_searched_for_a_preview(tmp_path: Path) -> None:
    content = jpeg(LARGE, exif=exif({0x0112: 6}, {0xA405: 26}))
    heads = {
        "a.raf": b"FUJIFILMCCD-RAW 0201",
        "a.orf": b"IIRO\x08\0\0\0",
        "a.rw2": b"IIU\0\x08\0\0\0",
    }
    heads["a.cr3"] = b"\0\0\0\x18ftypcrx \0\0\0\1crx isom"
    for name, head in heads.items():
        photo = load_photo(written(tmp_path / name, head + bytes(300) + content + bytes(999)))
        assert (photo.width, photo.height) == (900, 1200), name
        assert photo.focal_source is FocalSource.EXIF
    with pytest.raises(InputError, match="without a preview: develop it, and export a JPEG"):
        load_photo(written(tmp_path / "b.raf", b"FUJIFILMCCD-RAW 0201" + bytes(999)))


def test_the_tags_of_a_canon_file_of_boxes_are_found(tmp_path: Path) -> None:
    first, second = TiffFile(), TiffFile()
    image = first.begin_with(first.add_directory({0x0112: (3, [8])}))
    camera = second.begin_with(second.add_directory({0xA405: (3, [26])}))
    head = b"\0\0\0\x18ftypcrx \0\0\0\1crx isom"
    for name, tags in ((b"CMT1", image), (b"CMT2", camera)):
        head += struct.pack(">I", len(tags) + 8) + name + tags
    photo = load_photo(written(tmp_path / "a.cr3", head + jpeg(LARGE)))
    assert (photo.width, photo.focal_source) == (900, FocalSource.EXIF)


def test_a_damaged_preview_gives_way_to_the_next_one(tmp_path: Path) -> None:
    larger = bytearray(jpeg(picture(1600, 1200)))
    larger[-len(larger) // 2 :] = b"\xff\xd9" * (len(larger) // 4)
    content = raw_file(THUMBNAIL, bytes(larger)[:-9000], (40, 30)) + jpeg(LARGE)
    assert load_photo(written(tmp_path / "a.nef", content)).width in (1200, 1600)


# --- Projections


@pytest.mark.parametrize(
    ("properties", "words"),
    [
        ({"ProjectionType": "equirectangular"}, "equirectangular, 360°"),
        (
            {
                "ProjectionType": "equirectangular",
                "FullPanoWidthPixels": 4000,
                "CroppedAreaImageWidthPixels": 1500,
            },
            "135° of 360°",
        ),
        ({"ProjectionType": "cylindrical"}, "cylindrical"),
        ({"FullPanoWidthPixels": 4000, "FullPanoHeightPixels": 2000}, "equirectangular, 360°"),
        ({"ProjectionType": "rectilinear"}, None),
        ({"SourcePhotosCount": 2}, None),  # in ordinary photos of phones
    ],
)
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "AVIF"])
def test_a_panorama_is_refused_by_its_xmp(
    tmp_path: Path, kind: str, properties: dict[str, object], words: str | None
) -> None:
    xmp = gpano(**properties)
    options: dict[str, Any] = {"xmp": xmp}
    if kind == "PNG":
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp.decode())
        options = {"pnginfo": info}
    elif kind == "TIFF":
        options = {"tiffinfo": {700: xmp}}
    path = written(tmp_path / "pano.jpg", encoded(kind, **options))
    if words is None:
        assert load_photo(path).width == 64
        return
    with pytest.raises(InputError, match=words) as caught:
        load_photo(path)
    assert "panorama" in str(caught.value)
    assert "cut a flat view out of it" in str(caught.value)
    if kind == "JPEG":
        with Image.open(path) as image, pytest.raises(InputError, match="panorama"):
            photo_from_picture(image)


def test_a_360_photo_of_a_known_camera_needs_no_xmp(tmp_path: Path) -> None:
    for maker, model in (("RICOH", "RICOH THETA Z1"), ("Arashi Vision", "Insta360 ONE X2")):
        options = {"exif": exif({0x010F: maker, 0x0110: model})}
        with pytest.raises(InputError, match="360° panorama"):
            load_photo(written(tmp_path / "a", encoded("JPEG", picture(128, 64), **options)))
        # Their other pictures are flat.
        assert (
            load_photo(written(tmp_path / "a", encoded("JPEG", picture(), **options))).width == 64
        )


def test_a_panorama_that_imagemagick_made_a_png_is_refused(tmp_path: Path) -> None:
    xmp = gpano(ProjectionType="equirectangular", FullPanoWidthPixels=512)
    text = PngImagePlugin.PngInfo()
    text.add_text("Raw profile type xmp", f"\nxmp\n{len(xmp):8}\n{xmp.hex()}\n", zip=True)
    picture = io.BytesIO()
    Image.new("RGB", (64, 64)).save(picture, "PNG", pnginfo=text)
    with pytest.raises(InputError, match="a panorama"):
        load_photo(written(tmp_path / "a.png", picture.getvalue()))


def test_what_was_not_fetched_is_named_with_what_to_do(tmp_path: Path) -> None:
    for name, says in (
        ("pointer of Git LFS", "git lfs pull"),
        ("HTML", "download the file itself"),
        ("AppleDouble", "leave it out"),
    ):
        with pytest.raises(InputError, match=says):
            load_photo(written(tmp_path / "a.jpg", CODES_OF_KINDS[name] + bytes(200)))


def test_a_swept_panorama_of_an_iphone_is_refused(tmp_path: Path) -> None:
    swept = exif({0x010F: "Apple"}, {0xA401: 6})
    with pytest.raises(InputError, match="cylindrical"):
        load_photo(written(tmp_path / "a", encoded("JPEG", exif=swept)))
    portrait = exif({0x010F: "Apple"}, {0xA401: 8})
    assert load_photo(written(tmp_path / "a", encoded("JPEG", exif=portrait))).width == 64


def test_a_fisheye_is_refused_unless_it_is_corrected(tmp_path: Path) -> None:
    lens = exif({}, {0xA434: "EF8-15mm f/4L FISHEYE USM"})
    with pytest.raises(InputError, match=r"EF8-15mm f/4L FISHEYE USM.*correct the lens"):
        load_photo(written(tmp_path / "a", encoded("JPEG", exif=lens)))
    adobe = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        'xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/" '
        'xmlns:aux="http://ns.adobe.com/exif/1.0/aux/" {}/></rdf:RDF></x:xmpmeta>'
    )
    corrected = adobe.format('crs:LensProfileEnable="1" crs:AlreadyApplied="True"').encode()
    photo = load_photo(written(tmp_path / "a", encoded("JPEG", exif=lens, xmp=corrected)))
    assert photo.width == 64
    named = adobe.format('aux:Lens="16mm f/2.8D Fish-Eye"').encode()
    survey = b"<x:xmpmeta><Camera:ModelType>fisheye</Camera:ModelType></x:xmpmeta>"
    for xmp in (named, survey):
        with pytest.raises(InputError, match="fisheye"):
            load_photo(written(tmp_path / "a", encoded("JPEG", xmp=xmp)))


def test_a_360_photo_without_any_metadata_is_noticed_by_its_pixels(tmp_path: Path) -> None:
    y, x = np.mgrid[0:512, 0:1024]
    longitude, latitude = x / 1024 * 2 * np.pi, (0.5 - (y + 0.5) / 512) * np.pi
    point = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    waves = np.sin(7 * point[0] + 5 * point[1]) * np.sin(4 * point[2] + 3 * point[0])
    sphere = np.stack([waves, np.roll(waves, 50, axis=1), point[2]], axis=-1) * 100 + 128
    path = written(tmp_path / "a.png", encoded("PNG", sphere.astype(np.uint8)))
    assert load_photo(path).notes == (MAYBE_360_NOTE,)
    for flat in (picture(1024, 512), squares(np.arange(16)[:, None] * [16, 8, 4])[:, :1024]):
        path = written(tmp_path / "b.png", encoded("PNG", flat.astype(np.uint8)))
        assert load_photo(path).notes == ()
