"""Colour spaces: against LittleCMS, published values, and colour science written out."""

from __future__ import annotations

import io

import numpy as np
import pytest
from helpers.photo_files import (
    PRIMARIES,
    as_hlg,
    as_light,
    as_pq,
    as_srgb,
    icc_profile,
    pq_code,
    rgb_to_xyz,
    srgb_code,
)
from PIL import Image, ImageCms

from spackle.core.color_spaces import (
    ADOBE_RGB,
    SRGB,
    SRGB_TRANSFER,
    Chromaticities,
    ColorSpace,
    color_space_of_cicp,
    hlg_display_gain,
    hlg_to_scene,
    nits_to_pq,
    power_transfer,
    pq_to_nits,
    to_srgb,
    tone_gains,
)
from spackle.core.icc_profiles import color_space_of_icc, is_srgb_profile

COLORS = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
COLORS[0, :6] = [[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 255, 0], [0, 0, 255], [1, 2, 3]]


def space_of(name: str, gamma: float | None) -> ColorSpace:
    numbers = PRIMARIES[name]
    pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
    transfer = SRGB_TRANSFER if gamma is None else power_transfer(gamma)
    return ColorSpace.of(Chromaticities(*pairs), transfer, name)


def by_littlecms(colors: np.ndarray, profile: bytes) -> np.ndarray:
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    target = ImageCms.createProfile("sRGB")
    image = ImageCms.profileToProfile(Image.fromarray(colors), source, target, outputMode="RGB")
    assert image is not None
    return np.asarray(image)


@pytest.mark.parametrize("gamma", [None, 1.0, 1.8, 563 / 256])
@pytest.mark.parametrize("name", ["srgb", "adobe", "p3", "2020"])
def test_primaries_and_gamma_agree_with_littlecms(name: str, gamma: float | None) -> None:
    profile = icc_profile(name, gamma)
    theirs = by_littlecms(COLORS, profile)
    of_icc = color_space_of_icc(profile)
    assert of_icc is not None
    for space in (space_of(name, gamma), of_icc):
        ours = to_srgb(COLORS, 255, space).numpy() * 255
        assert abs(ours - theirs).max() < 1.6, space.name  # both round, LittleCMS in steps


def test_srgb_is_not_touched() -> None:
    assert (to_srgb(COLORS, 255, SRGB).numpy() == COLORS.astype(np.float32) / 255).all()
    assert color_space_of_cicp(1, 13).is_srgb
    assert color_space_of_cicp(2, 2).is_srgb  # unspecified
    assert not color_space_of_cicp(1, 13, is_full_range=False).is_srgb
    assert is_srgb_profile(icc_profile("srgb", None))
    assert not is_srgb_profile(icc_profile("srgb", 1.0))


def test_a_linear_profile_with_srgb_in_its_name_is_not_srgb() -> None:
    # GIMP writes such a profile for pictures in linear light.
    profile = icc_profile("srgb", 1.0).replace(b"made by hand", b"Linear sRGB!")
    assert not is_srgb_profile(profile)


# Published: SMPTE ST 2084 (and ITU-R BT.2408, table 1, in percent of PQ).
@pytest.mark.parametrize(
    ("nits", "code"),
    [(0, 0), (0.1, 0.062), (26, 0.38), (100, 0.508), (203, 0.581), (1000, 0.752), (10_000, 1)],
)
def test_pq_has_its_published_values(nits: float, code: float) -> None:
    assert float(nits_to_pq(np.array(nits))) == pytest.approx(code, abs=6e-4)
    assert float(pq_to_nits(nits_to_pq(np.array(nits)))) == pytest.approx(nits, rel=1e-6, abs=1e-6)
    assert float(pq_to_nits(pq_code(np.array(nits)))) == pytest.approx(nits, rel=1e-6, abs=1e-6)


# ITU-R BT.2408, table 1: nits at a peak of 1000, and percent of HLG, which are rounded.
@pytest.mark.parametrize(
    ("nits", "percent"), [(26, 38), (162, 71), (179, 73), (203, 75), (1000, 100)]
)
def test_hlg_has_the_reference_levels_of_bt_2408(nits: float, percent: float) -> None:
    scene = hlg_to_scene(np.array(percent / 100))
    shown = float(scene * hlg_display_gain(scene)) * 203
    # Half a percent of the signal is so much light at this level.
    lower, upper = (hlg_to_scene(np.array((percent + d) / 100)) for d in (-0.5, 0.5))
    steps = [float(s * hlg_display_gain(s)) * 203 for s in (lower, upper)]
    assert steps[0] < nits <= steps[1]
    assert shown == pytest.approx(nits, rel=0.04)


@pytest.mark.parametrize(("encode", "transfer"), [(as_pq, 16), (as_hlg, 18)])
def test_hdr_up_to_its_reference_white_comes_back_as_it_was(encode: object, transfer: int) -> None:
    code = encode(COLORS)  # type: ignore[operator]
    codes = np.clip(code * 65535, 0, 65535).round().astype(np.uint16)
    back = to_srgb(codes, 65535, color_space_of_cicp(9, transfer)).numpy() * 255
    assert abs(back - COLORS).max() < 0.6


def test_brighter_light_is_compressed_by_the_curve_of_bt_2390() -> None:
    # The formulas of Report ITU-R BT.2390 (EETF), for a mastering peak of 1000 nits.
    def reference(nits: float, peak: float = 1000.0, target: float = 203.0) -> float:
        e1 = pq_code(np.array(nits)) / pq_code(np.array(peak))
        max_lum = pq_code(np.array(target)) / pq_code(np.array(peak))
        ks = 1.5 * max_lum - 0.5
        if e1 < ks:
            return nits
        t = (e1 - ks) / (1 - ks)
        e2 = (
            (2 * t**3 - 3 * t**2 + 1) * ks
            + (t**3 - 2 * t**2 + t) * (1 - ks)
            + (-2 * t**3 + 3 * t**2) * max_lum
        )
        return float(pq_to_nits(e2 * pq_code(np.array(peak))))

    levels = np.array([1, 26, 90, 150, 203, 400, 700, 1000])
    codes = (pq_code(np.repeat(levels[:, None], 3, 1)) * 65535).round().astype(np.uint16)[None]
    ours = to_srgb(codes, 65535, color_space_of_cicp(9, 16)).numpy()[0, :, 0]
    theirs = srgb_code(np.array([reference(level) / 203 for level in levels]))
    assert abs(ours - theirs).max() < 1e-3
    # What is below the knee (92 nits here) is as in SDR, and the peak is white.
    assert ours[:2] == pytest.approx(srgb_code(levels[:2] / 203), abs=1e-3)
    assert ours[-1] == pytest.approx(1, abs=1e-3)
    assert (np.diff(ours) > 0).all()
    assert tone_gains(1.0).tolist() == [1.0] * len(tone_gains(1.0))


def test_hues_stay_where_light_is_compressed() -> None:
    bright = as_light(np.array([[[250, 200, 170]] * 4]), "2020") * [[[0.2], [1], [2], [4]]]
    codes = (pq_code(bright * 203) * 65535).round().astype(np.uint16)
    rgb = to_srgb(codes, 65535, color_space_of_cicp(9, 16)).numpy()[0]
    light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    ratios = light[:, 1] / light[:, 0]
    assert ratios == pytest.approx([ratios[0]] * 4, rel=0.03)


# ITU-T H.273: light for the middle code, by the formulas of its table 3.
@pytest.mark.parametrize(
    ("transfer", "light"),
    [
        (1, ((0.5 + 0.09929682680944) / 1.09929682680944) ** (1 / 0.45)),
        (4, 0.5**2.2),
        (5, 0.5**2.8),
        (6, ((0.5 + 0.09929682680944) / 1.09929682680944) ** (1 / 0.45)),
        (7, ((0.5 + 0.1115) / 1.1115) ** (1 / 0.45)),
        (8, 0.5),
        (9, 0.1),
        (10, 10**-1.25),
        (13, ((0.5 + 0.055) / 1.055) ** 2.4),
        (17, 52.37 / 48 * 0.5**2.6),
    ],
)
def test_each_transfer_function_of_cicp_is_its_formula(transfer: int, light: float) -> None:
    codes = np.full((1, 1, 3), 32768, np.uint16)
    ours = float(to_srgb(codes, 65535, color_space_of_cicp(1, transfer))[0, 0, 0])
    assert ours == pytest.approx(float(srgb_code(np.array(light))), abs=2e-4)


@pytest.mark.parametrize(("primaries", "name"), [(9, "2020"), (12, "p3")])
def test_the_primaries_of_cicp_are_converted(primaries: int, name: str) -> None:
    ours = to_srgb(COLORS, 255, color_space_of_cicp(primaries, 8)).numpy()
    assert abs(ours - as_srgb(COLORS / 255, name)).max() < 2e-4


def test_every_white_becomes_white() -> None:
    white = np.full((1, 1, 3), 255, np.uint8)
    for primaries in (1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 22):
        rgb = to_srgb(white, 255, color_space_of_cicp(primaries, 8))
        assert abs(rgb.numpy() - 1).max() < 1e-3, primaries


def test_a_narrow_range_is_widened() -> None:
    codes = np.array([0, 16, 126, 235, 255], np.uint8)
    rgb = to_srgb(
        np.repeat(codes[None, :, None], 3, 2), 255, color_space_of_cicp(1, 13, is_full_range=False)
    )
    assert rgb[0, :, 0].tolist() == pytest.approx([0, 0, 110 / 219, 1, 1], abs=1e-3)
    ten_bits = np.full((1, 1, 3), 16 * 4, np.uint16)
    assert (
        float(to_srgb(ten_bits, 1023, color_space_of_cicp(9, 16, is_full_range=False)).max()) == 0
    )


def test_the_fast_conversion_agrees_with_the_formula_at_every_code() -> None:
    codes = np.arange(65536, dtype=np.uint16).reshape(256, 256, 1).repeat(3, axis=2)
    light = (np.arange(65536) / 65535) ** (563 / 256)
    expected = srgb_code(light).reshape(256, 256)
    # Grey stays grey, so the primaries do not matter.
    assert abs(to_srgb(codes, 65535, ADOBE_RGB).numpy() - expected[..., None]).max() < 1e-4


@pytest.mark.parametrize(
    "wrong",
    [
        Chromaticities((0.3, 0.3), (0.3, 0.3), (0.3, 0.3), (0.3, 0.3)),
        Chromaticities((0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3, 0.0)),
        Chromaticities((0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.9, 0.05)),
    ],
)
def test_primaries_that_span_no_colours_are_refused(wrong: Chromaticities) -> None:
    with pytest.raises(ValueError, match=r"prim|luminance"):
        ColorSpace.of(wrong, SRGB_TRANSFER, "wrong")


def test_the_matrix_of_srgb_is_the_published_one() -> None:
    # IEC 61966-2-1, adapted to D50 as ICC's sRGB profile has it.
    published = [[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]]
    assert abs(SRGB.to_xyz - np.array(published)).max() < 3e-4
    assert abs(rgb_to_xyz("srgb")[1] - [0.2126, 0.7152, 0.0722]).max() < 1e-3
