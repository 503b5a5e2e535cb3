"""Photos whose colours are stated in any way: each becomes the sRGB that it means."""

from __future__ import annotations

import io
import itertools
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.photo_files import (
    ADOBE_RGB_BY_EXIF,
    PATCHES,
    PRIMARIES,
    SQUARE,
    as_hlg,
    as_light,
    as_pq,
    as_srgb,
    av1_item,
    avif,
    box,
    chrm,
    colors_of,
    deep_tiff,
    exif,
    full_box,
    gpano,
    heic,
    icc_profile,
    ispe,
    item_file,
    jpeg,
    nclx,
    png,
    pq_code,
    raw_file,
    squares,
    srgb_light,
    tiff,
)
from PIL import Image

from spackle.core.photo import load_photo, photo_from_picture

ADOBE_GAMMA = 563 / 256
CODES = squares(PATCHES).astype(np.uint8)
DEEP = squares(np.linspace(0, 1, 6)[:, None] * [1, 0.8, 0.6])  # light in 0..1, also dark
DEEP_CODES = (DEEP * 65535).round().astype(np.uint16)


def saved(image: Image.Image, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def read(tmp_path: Path, content: bytes, name: str = "photo.jpg") -> np.ndarray:
    """The colours of the squares of a photo, in 0..1."""
    (tmp_path / name).write_bytes(content)
    return colors_of(load_photo(tmp_path / name).rgb.numpy())


def meaning(primaries: str, gamma: float | None) -> np.ndarray:
    """sRGB in 0..1 of the patches, if their numbers are those of this colour space."""
    numbers = PATCHES / 255
    return as_srgb(srgb_light(numbers) if gamma is None else numbers**gamma, primaries)


IMAGE = Image.fromarray(CODES)
ADOBE_EXIF = exif({}, ADOBE_RGB_BY_EXIF)
P3 = ("p3", None)
ADOBE = ("adobe", ADOBE_GAMMA)
SAME = ("srgb", None)
GAMMA_1 = (b"gAMA", struct.pack(">I", 100_000))
GAMMA_18 = (b"gAMA", struct.pack(">I", 55_556))
GAMMA_USUAL = (b"gAMA", struct.pack(">I", 45_455))
CICP_P3 = (b"cICP", bytes([12, 13, 0, 1]))
SRGB_CHUNK = (b"sRGB", b"\0")
UNCALIBRATED = {0xA001: 0xFFFF}


def iccp(profile: bytes) -> tuple[bytes, bytes]:
    import zlib

    return b"iCCP", b"x\0\0" + zlib.compress(profile)


def bitmap(primaries: str, gamma: float) -> bytes:
    """A BMP of version 4 with endpoints and gammas."""
    plain = saved(IMAGE, "BMP")
    x, y = np.array(PRIMARIES[primaries][:6]).reshape(3, 2).T
    white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
    columns = np.stack([x, y, 1 - x - y])
    endpoints = (columns * np.linalg.solve(columns, white)).T.ravel()
    calibrated = struct.pack("<9i", *(round(number * 2**30) for number in endpoints))
    calibrated += struct.pack("<3I", *[round(gamma * 65536)] * 3)
    header = struct.pack("<I", 108) + plain[18:54] + bytes(16) + b"\0\0\0\0" + calibrated
    offset = 14 + len(header)
    return plain[:10] + struct.pack("<I", offset) + header + plain[54:]


PLAIN_TIFF = tiff(CODES)
TIFF_PRIMARIES = {
    318: (5, [31270, 100_000, 32900, 100_000]),
    319: (5, [n for c in PRIMARIES["adobe"][:6] for n in (round(c * 100_000), 100_000)]),
}
POWER_TABLE = ((np.arange(256) / 255) ** 1.8 * 65535).round().astype(int).tolist()
EXIF_PRIMARIES = exif(
    {0x013E: (0.3127, 0.3290), 0x013F: PRIMARIES["p3"][:6]}, {**UNCALIBRATED, 0xA500: 2.2}
)

STATEMENTS: dict[str, tuple[Callable[[], bytes], tuple[str, float | None]]] = {
    # JPEG: an ICC profile, then EXIF
    "JPEG": (lambda: jpeg(CODES), SAME),
    "JPEG, ICC": (lambda: jpeg(CODES, icc_profile=icc_profile("p3", None)), P3),
    "JPEG, EXIF R03": (lambda: jpeg(CODES, exif=ADOBE_EXIF), ADOBE),
    "JPEG, EXIF 2": (lambda: jpeg(CODES, exif=exif({}, {0xA001: 2})), ADOBE),
    "JPEG, EXIF sRGB": (lambda: jpeg(CODES, exif=exif({}, {0xA001: 1})), SAME),
    "JPEG, EXIF primaries": (lambda: jpeg(CODES, exif=EXIF_PRIMARIES), ("p3", ADOBE_GAMMA)),
    "JPEG, ICC before EXIF": (
        lambda: jpeg(CODES, exif=ADOBE_EXIF, icc_profile=icc_profile("p3", None)),
        P3,
    ),
    # WebP
    "WebP, ICC": (
        lambda: saved(IMAGE, "WEBP", lossless=True, icc_profile=icc_profile("p3", None)),
        P3,
    ),
    "WebP, EXIF R03": (lambda: saved(IMAGE, "WEBP", lossless=True, exif=ADOBE_EXIF), ADOBE),
    # PNG: cICP, then iCCP, then sRGB, then gAMA and cHRM
    "PNG": (lambda: png(CODES), SAME),
    "PNG, cICP": (lambda: png(CODES, CICP_P3), P3),
    "PNG, iCCP": (lambda: png(CODES, iccp(icc_profile("adobe", ADOBE_GAMMA))), ADOBE),
    "PNG, gAMA 1": (lambda: png(CODES, GAMMA_1), ("srgb", 1.0)),
    "PNG, gAMA 1/1.8": (lambda: png(CODES, GAMMA_18), ("srgb", 1.8)),
    "PNG, gAMA as usual": (lambda: png(CODES, GAMMA_USUAL), SAME),
    "PNG, cHRM": (lambda: png(CODES, (b"cHRM", chrm("p3"))), P3),
    "PNG, cHRM and gAMA": (lambda: png(CODES, (b"cHRM", chrm("2020")), GAMMA_18), ("2020", 1.8)),
    "PNG, sRGB before gAMA": (lambda: png(CODES, GAMMA_1, (b"cHRM", chrm("p3")), SRGB_CHUNK), SAME),
    "PNG, iCCP before gAMA": (lambda: png(CODES, GAMMA_1, iccp(icc_profile("p3", None))), P3),
    "PNG, cICP before all": (
        lambda: png(CODES, iccp(icc_profile("adobe", 2.2)), GAMMA_1, CICP_P3),
        P3,
    ),
    "PNG, eXIf R03": (lambda: png(CODES, (b"eXIf", ADOBE_EXIF.removeprefix(b"Exif\0\0"))), ADOBE),
    # TIFF
    "TIFF": (lambda: PLAIN_TIFF, SAME),
    "TIFF, ICC": (
        lambda: tiff(CODES, {34675: (7, icc_profile("p3", None)), **TIFF_PRIMARIES}),
        P3,
    ),
    "TIFF, primaries": (lambda: tiff(CODES, TIFF_PRIMARIES), ADOBE),
    "TIFF, transfer function": (
        lambda: tiff(CODES, {301: (3, POWER_TABLE * 3)}),
        ("srgb", 1.8),
    ),
    # BMP
    "BMP": (lambda: saved(IMAGE, "BMP"), SAME),
    "BMP, endpoints": (lambda: bitmap("adobe", ADOBE_GAMMA), ADOBE),
    # HEIF and AVIF: ICC, then CICP
    "HEIC, nclx P3": (lambda: heic(CODES / 255, 12, 13, 6), P3),
    "AVIF, nclx P3": (lambda: avif(CODES / 255, nclx(12, 13, 9)), P3),
    "AVIF, ICC before nclx": (
        lambda: avif(
            CODES / 255, box(b"colr", b"prof", icc_profile("adobe", ADOBE_GAMMA)), nclx(12, 13, 9)
        ),
        ADOBE,
    ),
    "AVIF, narrow range": (
        lambda: avif(CODES / 255, nclx(12, 13, 9, full_range=False), full_range=False),
        P3,
    ),
    "raw, preview in Adobe RGB": (
        lambda: raw_file(CODES[:8, :8], jpeg(CODES), (96, 200), extra={50970: (4, [3])}),
        ADOBE,
    ),
}


@pytest.mark.parametrize("name", STATEMENTS)
def test_a_photo_becomes_the_srgb_that_its_file_means(tmp_path: Path, name: str) -> None:
    content, (primaries, gamma) = STATEMENTS[name]
    ours = read(tmp_path, content()) * 255
    # LittleCMS and lossy files round; 3 of 255 are far below the difference of the spaces.
    assert abs(ours - meaning(primaries, gamma) * 255).max() < 4


HDR = {
    "HEIC, PQ": lambda: heic(as_pq(CODES), 9, 16),
    "HEIC, HLG": lambda: heic(as_hlg(CODES), 9, 18),
    "AVIF, PQ": lambda: avif(as_pq(CODES), nclx(9, 16, 9)),
    "AVIF, HLG": lambda: avif(as_hlg(CODES), nclx(9, 18, 9)),
    "AVIF, PQ, narrow range": lambda: avif(
        as_pq(CODES), nclx(9, 16, 9, full_range=False), full_range=False
    ),
    "AVIF, ICC with the numbers of PQ": lambda: avif(
        as_pq(CODES), box(b"colr", b"prof", icc_profile("2020", 2.2, cicp=bytes([9, 16, 0, 1])))
    ),
    "AVIF, ICC named PQ": lambda: avif(
        as_pq(CODES),
        box(b"colr", b"prof", icc_profile("2020", 2.2).replace(b"made by hand", b"Rec. 2100 PQ")),
    ),
    "PNG of 8 bits, PQ": lambda: png(
        (as_pq(CODES) * 255).round().astype(np.uint8), (b"cICP", bytes([9, 16, 0, 1]))
    ),
    "PNG of 16 bits, PQ": lambda: png(
        (as_pq(CODES) * 65535).round().astype(np.uint16), (b"cICP", bytes([9, 16, 0, 1]))
    ),
    "PNG of 16 bits, HLG": lambda: png(
        (as_hlg(CODES) * 65535).round().astype(np.uint16), (b"cICP", bytes([9, 18, 0, 1]))
    ),
}


@pytest.mark.parametrize("name", HDR)
def test_hdr_becomes_the_sdr_picture_that_it_was(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.heic").write_bytes(HDR[name]())
    photo = load_photo(tmp_path / "a.heic")
    # A step of 8 bits of PQ is 3 of 255; the others have 10 bits and more.
    worst = 5 if "8 bits" in name else 3
    assert abs(colors_of(photo.rgb.numpy()) * 255 - PATCHES).max() < worst
    assert any("HDR colours" in note for note in photo.notes)


def test_light_above_white_is_compressed_and_keeps_its_order(tmp_path: Path) -> None:
    nits = np.array([10, 50, 100, 203, 500, 1000])
    code = squares(pq_code(np.repeat(nits[:, None], 3, axis=1)))
    rgb = read(
        tmp_path, png((code * 65535).round().astype(np.uint16), (b"cICP", bytes([9, 16, 0, 1])))
    )
    levels = rgb.mean(axis=1)
    assert (np.diff(levels) > 0.005).all()
    assert levels[0] == pytest.approx(0.246, abs=0.01)  # 10 of 203 nits, as in SDR
    assert levels[3] == pytest.approx(0.9, abs=0.02)  # white makes room for 1000 nits
    assert levels[-1] == pytest.approx(1.0, abs=0.005)


# Of 8 bits, dark linear light would have two levels below 1/255.
DARK = squares(np.array([0.0005, 0.001, 0.002, 0.004, 0.01, 0.03])[:, None] * [1, 1, 1])
DARK_CODES = (DARK * 65535).round().astype(np.uint16)
DEEP_FILES = {
    "PNG, RGB": lambda: png(DARK_CODES, GAMMA_1),
    "PNG, RGBA": lambda: png(
        np.concatenate([DARK_CODES, np.full_like(DARK_CODES[..., :1], 65535)], axis=-1), GAMMA_1
    ),
    "PNG, grey and alpha": lambda: png(
        np.stack([DARK_CODES[..., 0], np.full_like(DARK_CODES[..., 0], 65535)], axis=-1), GAMMA_1
    ),
    "PNG, grey": lambda: png(DARK_CODES[..., 0], GAMMA_1),
    "PNG, deep with ICC": lambda: png(DARK_CODES, iccp(icc_profile("srgb", 1.0))),
    "PNG, grey ICC": lambda: png(DARK_CODES[..., 0], iccp(icc_profile("srgb", 1.0, kind=b"GRAY"))),
    "TIFF, RGB": lambda: tiff(DARK_CODES, {34675: (7, icc_profile("srgb", 1.0))}),
    "TIFF, grey": lambda: tiff(
        DARK_CODES[..., 0], {34675: (7, icc_profile("srgb", 1.0, kind=b"GRAY"))}, photometric=1
    ),
    "TIFF, negative": lambda: tiff(
        65535 - DARK_CODES[..., 0],
        {34675: (7, icc_profile("srgb", 1.0, kind=b"GRAY"))},
        photometric=0,
    ),
}


@pytest.mark.parametrize("name", DEEP_FILES)
def test_sixteen_bits_are_kept_until_the_colours_are_converted(tmp_path: Path, name: str) -> None:
    rgb = read(tmp_path, DEEP_FILES[name]())
    assert abs(rgb - colors_of(as_srgb(DARK, "srgb"))).max() < 0.002


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compression", [1, 5, 8, 32773])
def test_every_layout_of_a_deep_tiff_is_read(tmp_path: Path, compression: int, order: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (45, 70, 3)).astype(np.uint16)
    for predictor, planar, tile in itertools.product(
        (False, True), (False, True), (None, (16, 32))
    ):
        layout = {"predictor": predictor, "planar": planar, "tile": tile}
        content = deep_tiff(pixels, order=order, compression=compression, **layout)
        (tmp_path / "a.tif").write_bytes(content)
        rgb = load_photo(tmp_path / "a.tif").rgb.numpy()
        assert abs(rgb - pixels / 65535).max() < 1e-6, layout


def test_premultiplied_colours_of_a_deep_tiff_are_undone(tmp_path: Path) -> None:
    half = np.concatenate([DEEP_CODES // 2, np.full_like(DEEP_CODES[..., :1], 32768)], axis=-1)
    rgb = read(tmp_path, tiff(half, {338: (3, [1])}))
    assert abs(rgb - (colors_of(DEEP) / 2 + 0.5)).max() < 1e-4


def test_a_deep_animated_png_gives_its_first_picture(tmp_path: Path) -> None:
    control = (b"acTL", struct.pack(">II", 2, 0))
    height, width = DARK_CODES.shape[:2]
    shown = (b"fcTL", struct.pack(">5I2H2B", 0, width, height, 0, 0, 1, 1, 0, 0))
    rgb = read(tmp_path, png(DARK_CODES, GAMMA_1, control, shown))
    assert abs(rgb - colors_of(as_srgb(DARK, "srgb"))).max() < 0.002


def test_ten_bits_are_kept(tmp_path: Path) -> None:
    # Neighbouring codes of 10 bits: 8 bits would join four of them.
    code = squares(np.repeat((np.arange(400, 406) / 1023)[:, None], 3, axis=1))
    for content in (heic(code, 9, 16), avif(code, nclx(9, 16, 9))):
        levels = read(tmp_path, content).mean(axis=1)
        assert len(np.unique(levels.round(4))) >= 5


def test_a_grid_of_tiles_with_ten_bits_is_put_together(tmp_path: Path) -> None:
    code = as_pq(squares(PATCHES))
    whole = np.concatenate([code, code[:, ::-1]])  # [128, 384]
    size = (376, 120)  # the last tiles reach beyond the picture
    grid = struct.pack(">4B2H", 0, 0, 1, 1, *size)
    items = [(b"grid", grid, [ispe(*size), nclx(9, 16, 9)])]
    for rows in (whole[:64], whole[64:]):
        for part in (rows[:, :192], rows[:, 192:]):
            content, properties = av1_item(part)
            items.append((b"av01", content, [*properties, nclx(9, 16, 9)]))
    (tmp_path / "a.avif").write_bytes(
        item_file(items, references=[(b"dimg", 1, [2, 3, 4, 5])], hidden=[2, 3, 4, 5])
    )
    photo = load_photo(tmp_path / "a.avif")
    assert (photo.width, photo.height) == size
    top = photo.rgb[SQUARE // 2, SQUARE // 2 :: SQUARE].numpy() * 255
    bottom = photo.rgb[SQUARE + SQUARE // 2, SQUARE // 2 :: SQUARE].numpy() * 255
    assert abs(top - PATCHES).max() < 4
    assert abs(bottom[:5] - PATCHES[::-1][:5]).max() < 4


def test_hdr_in_the_compressed_picture_alone_is_seen(tmp_path: Path) -> None:
    content, properties = av1_item(as_pq(CODES), cicp=(9, 16))
    file = item_file([(b"av01", content, properties)])
    assert b"colr" not in file
    assert abs(read(tmp_path, file) * 255 - PATCHES).max() < 3
    # A statement that any video encoder writes is not believed.
    content, properties = av1_item(CODES / 255, cicp=(1, 1))
    file = item_file([(b"av01", content, properties)])
    assert abs(read(tmp_path, file) * 255 - PATCHES).max() < 3


def test_a_turned_avif_with_ten_bits_is_upright(tmp_path: Path) -> None:
    turn = box(b"irot", b"\1")  # a quarter against the clock
    (tmp_path / "a.avif").write_bytes(avif(as_pq(CODES), nclx(9, 16, 9), turn))
    rgb = load_photo(tmp_path / "a.avif").rgb.numpy()
    assert rgb.shape == (CODES.shape[1], CODES.shape[0], 3)
    assert abs(colors_of(np.rot90(rgb, -1)) * 255 - PATCHES).max() < 3


def test_an_avif_with_ten_bits_keeps_its_opacity(tmp_path: Path) -> None:
    colors, properties = av1_item(as_pq(CODES))
    half, own = av1_item(np.full((*CODES.shape[:2], 3), 0.5))
    kind = b"urn:mpeg:mpegB:cicp:systems:auxiliary:alpha\0"
    items = [
        (b"av01", colors, [*properties, nclx(9, 16, 9)]),
        (b"av01", half, [*own, full_box(b"auxC", kind)]),
    ]
    rgb = read(tmp_path, item_file(items, references=[(b"auxl", 2, [1])]))
    assert abs(rgb * 255 - (PATCHES + 255) / 2).max() < 3


def test_transparency_lies_over_white_in_any_space(tmp_path: Path) -> None:
    alpha = np.full((*CODES.shape[:2], 1), 128, np.uint8)
    rgb = read(tmp_path, png(np.concatenate([CODES, alpha], axis=-1), CICP_P3))
    share = 128 / 255
    assert abs(rgb - (meaning("p3", None) * share + 1 - share)).max() < 0.01


def test_what_cannot_be_honoured_is_said(tmp_path: Path) -> None:
    cases = {
        "uncalibrated": jpeg(CODES, exif=exif({}, UNCALIBRATED)),
        "ICC profile is damaged": jpeg(CODES, icc_profile=b"no profile at all" * 20),
        "CMYK without an ICC profile": saved(IMAGE.convert("CMYK"), "JPEG", quality=95),
        "make no colour space": png(CODES, (b"cHRM", struct.pack(">8I", *[30_000] * 8))),
    }
    for words, content in cases.items():
        (tmp_path / "a").write_bytes(content)
        photo = load_photo(tmp_path / "a")
        assert any(words in note for note in photo.notes), words
    (tmp_path / "a").write_bytes(jpeg(CODES))
    assert load_photo(tmp_path / "a").notes == ()


def test_pictures_in_memory_keep_what_pillow_knows_of_their_colours(tmp_path: Path) -> None:
    files = {
        ("p3", None): jpeg(CODES, icc_profile=icc_profile("p3", None)),
        ("adobe", ADOBE_GAMMA): jpeg(CODES, exif=ADOBE_EXIF),
        ("2020", 1.8): png(CODES, (b"cHRM", chrm("2020")), GAMMA_18),
        ("p3", 1.0): png(CODES, (b"cICP", bytes([12, 8, 0, 1]))),
        ("2020", None): avif(CODES / 255, nclx(9, 13, 9)),
    }
    for (primaries, gamma), content in files.items():
        image = Image.open(io.BytesIO(content))
        photo = photo_from_picture(image)
        assert np.asarray(image.convert("RGB")).shape == CODES.shape  # it can still be used
        ours = colors_of(photo.rgb.numpy())
        assert abs(ours - meaning(primaries, gamma)).max() * 255 < 4, primaries
        # A picture that is loaded already knows the name of its file.
        (tmp_path / "a").write_bytes(content)
        with Image.open(tmp_path / "a") as image:
            image.load()
            photo = photo_from_picture(image)
        ours = colors_of(photo.rgb.numpy())
        assert abs(ours - meaning(primaries, gamma)).max() * 255 < 4, primaries


def test_each_statement_on_the_page_is_read_in_a_test() -> None:
    page = (Path(__file__).parents[2] / "docs" / "inputs.md").read_text(encoding="utf-8")
    section = page.split("### Colours")[1].split("### What is no")[0]
    cells = re.findall(r"^\|.*\| ([^|]+) \|$", section, re.MULTILINE)
    named = {name.strip() for cell in cells for name in cell.split(";")} - {"kinds"}
    plain = {"JPEG", "PNG", "TIFF", "BMP"}  # state nothing
    assert named == {*STATEMENTS, *HDR, *DEEP_FILES} - plain


def test_lab_pictures_become_srgb(tmp_path: Path) -> None:
    from PIL import ImageCms

    lab = ImageCms.profileToProfile(
        IMAGE, ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"), outputMode="LAB"
    )
    assert lab is not None
    # L*a*b* of 8 bits has coarse steps in saturated colours.
    assert abs(read(tmp_path, saved(lab, "TIFF")) * 255 - PATCHES).max() < 10


def test_metadata_of_panoramas_does_not_disturb_the_colours(tmp_path: Path) -> None:
    flat = gpano(ProjectionType="rectilinear")
    assert abs(read(tmp_path, jpeg(CODES, xmp=flat)) * 255 - PATCHES).max() < 4
    assert as_light(PATCHES, "srgb").shape == PATCHES.shape
