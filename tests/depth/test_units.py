"""Units and meanings of depth: every row of the table in docs/inputs.md, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import DepthValue, load_depth
from spackle.depth.units import UnclearDepth, parse_depth_unit
from spackle.runtime.errors import InputError

INPUTS = Path(__file__).parents[2] / "docs" / "inputs.md"
Floats = NDArray[np.float32]


def truth() -> Floats:
    """Depth from 1.6 to 60 m, and 4 unknown pixels, [40, 64]."""
    rows, columns = np.mgrid[0:40, 0:64]
    depth = (1.6 + 58.4 * (columns + 0.1 * rows) / 66.9).astype(np.float32)
    depth[:2, :2] = 0
    return depth


# Writers of other programs.


def write_npy(path: Path, numbers: NDArray[Any]) -> None:
    with open(path, "wb") as file:
        np.save(file, numbers)


def write_pfm(path: Path, numbers: NDArray[Any]) -> None:
    cv2 = pytest.importorskip("cv2")
    assert cv2.imwrite(f"{path}.pfm", numbers.astype(np.float32))
    Path(f"{path}.pfm").rename(path)


def write_exr(path: Path, numbers: NDArray[Any]) -> None:
    exr = pytest.importorskip("OpenEXR")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, {"Z": np.ascontiguousarray(numbers)}) as file:
        file.write(str(path))


def write_tiff(path: Path, numbers: NDArray[Any]) -> None:
    pytest.importorskip("tifffile").imwrite(path, numbers, compression="zlib")


def write_png(path: Path, numbers: NDArray[Any]) -> None:
    io = pytest.importorskip("skimage.io")
    io.imsave(f"{path}.png", numbers, check_contrast=False)
    Path(f"{path}.png").rename(path)


def whole(numbers: Floats, dtype: Any = np.uint16) -> NDArray[Any]:
    return np.round(numbers).astype(dtype)


def inverse(depth: Floats) -> Floats:
    return np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)


def normalised(numbers: Floats) -> Floats:
    known = numbers[numbers > 0]
    share = (numbers - known.min()) / np.float32(known.max() - known.min())
    return np.where(numbers > 0, share, np.nan).astype(np.float32)


# Of each row of the table: what writes the file, which numbers it holds, how it is read, and the
# error of the depth that rounding explains, relative to a depth of 1.6 to 60 m.
Row = tuple[Callable[[Path, Any], None], Callable[[Floats], Any], dict[str, Any], float]
ROWS: dict[str, Row] = {
    "`.npy`, `.npz`, metres": (write_npy, lambda z: z, {}, 0),
    "`.pfm`, metres": (write_pfm, lambda z: z, {}, 0),
    "`.exr`, metres": (write_exr, lambda z: z, {}, 0),
    "`.tif`, metres": (write_tiff, lambda z: z, {}, 0),
    "16-bit `.tif`, millimetres": (write_tiff, lambda z: whole(1000 * z, ">u2"), {}, 4e-4),
    "16-bit `.png`, millimetres": (write_png, lambda z: whole(1000 * z), {}, 4e-4),
    "KITTI (`.png`, 1/256 m)": (write_png, lambda z: whole(256 * z), {"unit": "1/256"}, 2e-3),
    "TUM RGB-D (`.png`, 1/5000 m)": (
        write_png,
        lambda z: whole(1000 * z),  # 5000 · 60 would leave 16 bits: a room, not a street
        {"unit": "1/5000"},
        4e-4,
    ),
    "Virtual KITTI (`.png`, centimetres)": (
        write_png,
        lambda z: whole(100 * z),
        {"unit": "cm"},
        4e-3,
    ),
    "RealSense (`.png`, 0.1 mm)": (
        write_png,
        lambda z: whole(1000 * z),  # as for TUM
        {"unit": "0.1 mm"},
        4e-4,
    ),
    "`.npy` of millimetres": (write_npy, lambda z: 1000 * z, {"unit": "mm"}, 1e-6),
    "`.npy` of integers": (write_npy, lambda z: whole(1000 * z, ">u2"), {"unit": "mm"}, 4e-4),
    "inverse metres (Depth Pro, Apple)": (write_npy, inverse, {"unit": "1/m"}, 1e-6),
    "MiDaS `.pfm`": (
        write_pfm,
        lambda z: np.where(z > 0, 9000 * inverse(z) + 400, np.nan),
        {"kind": "near-white"},
        2e-2,
    ),
    "Depth Anything `.npy`": (
        write_npy,
        lambda z: np.where(z > 0, 9 * inverse(z) + 1, np.nan),
        {"kind": "near-white"},
        2e-2,
    ),
    "Depth Anything `.tif`": (
        write_tiff,
        lambda z: np.where(z > 0, 9 * inverse(z) + 1, np.nan),
        {"kind": "near-white"},
        2e-2,
    ),
    "greys of ComfyUI (`.png`)": (
        write_png,
        lambda z: whole(255 * np.nan_to_num(normalised(inverse(z))), np.uint8),
        {"kind": "near-white"},
        0.25,  # an 8-bit step is a quarter of the depth at 60 m
    ),
    "Marigold `.npy`, 0 to 1": (write_npy, normalised, {"kind": "near-black"}, 1e-5),
}


@pytest.mark.parametrize("row", ROWS)
def test_each_row_of_the_table_is_read_as_it_says(row: str, tmp_path: Path) -> None:
    write, numbers_of, options, tolerance = ROWS[row]
    depth = truth()
    write(tmp_path / "map", numbers_of(depth))
    if row in ("TUM RGB-D (`.png`, 1/5000 m)", "RealSense (`.png`, 0.1 mm)"):
        depth = depth * np.float32(1000 * parse_depth_unit(options["unit"]).factor)
    known = depth > 0
    options = dict(options)
    if "kind" in options:  # relative: near and far are those of the truth
        near, far = np.quantile(depth[known], [0.01, 0.99])
        options |= {"near": float(near), "far": float(far)}
    found = load_depth(tmp_path / "map", **options)
    error = np.abs(found.depth.numpy() / np.where(known, depth, 1) - 1)[known]
    assert error.max() <= max(tolerance, 1e-7)
    # Greys have no number for "unknown"; everything else keeps these four pixels.
    assert found.valid.numpy()[~known].any() == row.startswith("greys")
    assert found.is_guess == (not options)


def test_the_table_has_these_rows_and_options() -> None:
    text = INPUTS.read_text(encoding="utf-8")
    table = text[text.index("## Depth\n") : text.index("## Scenes\n")]
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| *([^|]*?) *\|$", table, re.MULTILINE)
    assert rows.pop(0) == ("file", "option")
    assert [name for name, _ in rows] == list(ROWS)
    for name, option in rows:
        _, _, options, _ = ROWS[name]
        given = {**options}
        words = [f"--depth-{key} {value}" for key, value in given.items()]
        assert option.replace('"', "").replace("`", "").strip() == " ".join(words)


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ("m", 1),
        ("cm", 0.01),
        ("mm", 0.001),
        ("km", 1000),
        ("1/256", 1 / 256),
        ("1/5000", 0.0002),
        ("0.1 mm", 0.0001),
        ("0.1mm", 0.0001),
        ("1e-3", 0.001),
        (" .5 ", 0.5),
        ("2/3 m", 2 / 3),
        (0.001, 0.001),
        (1, 1),
    ],
)
def test_units(text: str | float, factor: float) -> None:
    unit = parse_depth_unit(text)
    assert unit.factor == pytest.approx(factor, rel=1e-12)
    assert not unit.is_inverse


@pytest.mark.parametrize(
    "text",
    ["", " ", "foot", "1/0", "0", "-1", "1e99", "1e-99", "nan", "inf", "1/2/3", "1 / m", "m/256"],
)
def test_other_units_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"`depth_unit`.*give m, cm, mm or km"):
        parse_depth_unit(text)


def test_a_unit_contradicts_relative_depth(tmp_path: Path) -> None:
    write_npy(tmp_path / "d.npy", truth())
    with pytest.raises(InputError, match="`depth_unit` mm: only for metric depth"):
        load_depth(tmp_path / "d.npy", kind="near-white", unit="mm")


def test_a_stated_unit_counts_more_than_a_calibration_in_the_folder(tmp_path: Path) -> None:
    write_png(tmp_path / "disp0.png", whole(256 * truth()))
    (tmp_path / "calib.txt").write_text("cam0=[100 0 32; 0 100 20; 0 0 1]\nbaseline=100\ndoffs=0\n")
    assert load_depth(tmp_path / "disp0.png").quantity == "disparity"
    found = load_depth(tmp_path / "disp0.png", unit="1/256")
    assert found.quantity == "depth"
    assert float(found.depth.max()) == pytest.approx(60, rel=1e-3)


def test_the_line_about_a_map_says_how_it_was_read() -> None:
    found = load_depth(DepthValue(truth()))
    assert found.meaning == "metres"
    assert found.range_in_words == "near 3.31 m, median 30.8 m, far 58.5 m"
    assert load_depth(DepthValue(truth()), unit="1/256").meaning == "units of 1/256 m"


SLOPE = np.linspace(0, 1, 400, dtype=np.float32).reshape(20, 20)
UNCLEAR = [  # numbers that are hardly metres, and a part of the message
    (SLOPE, "fill the range from 0 to 1"),
    (SLOPE.astype(np.float16), "fill the range from 0 to 1"),
    (255 * SLOPE, "fill the range from 0 to 255"),
    (9000 * SLOPE + 1000, "values around 5.* are hardly metres"),
    (65535 * SLOPE, "values around 32.* are hardly metres"),
    (2500 + 100 * SLOPE, "values around 25.* are hardly metres"),
    (whole(3000 * SLOPE, np.int32), "integers around 1500 are hardly metres"),
    (whole(400 * SLOPE, np.uint16), "integers around 200 are hardly metres"),  # a desk in mm
    (whole(255 * SLOPE, np.uint8), "8 bits"),
    (Image.fromarray(whole(255 * SLOPE, np.uint8)), "8 bits"),
    (Image.fromarray(whole(65535 * SLOPE)), "fill the range of 16 bits"),
    (Image.fromarray(whole(255 * SLOPE, np.uint8)).convert("RGB"), "mode RGB"),
]


def test_a_coloured_picture_is_refused_at_once() -> None:
    colors = np.stack([whole(255 * SLOPE, np.uint8), whole(99 * SLOPE, np.uint8)] * 2, -1)[..., :3]
    for kind in ("auto", "near-white"):
        with pytest.raises(InputError, match="a colour picture does not tell near from far"):
            load_depth(DepthValue(Image.fromarray(colors)), kind=kind)


@pytest.mark.parametrize(("value", "says"), UNCLEAR)
def test_numbers_that_are_hardly_metres_are_refused(value: Any, says: str) -> None:
    with pytest.raises(UnclearDepth, match=rf"^depth: .*{says}.*`depth_kind` near-white"):
        load_depth(DepthValue(value))
    # Whoever says what they are is believed.
    assert load_depth(DepthValue(value), kind="near-black").valid.any()
    if not (isinstance(value, Image.Image) and value.mode == "RGB"):
        assert load_depth(DepthValue(value), unit=0.01).valid.any()


def test_ordinary_metres_are_no_relative_depth() -> None:
    depth = truth()
    sky = depth.copy()
    sky[:25] = 1e10  # a renderer's background
    valley = np.where(depth > 0, 30 * depth, 0)  # up to 1.8 km
    close = depth / 61  # up to 0.98 m
    for numbers in (depth, sky, valley, close, 1e-3 * depth, np.full((20, 20), 1.0)):
        found = load_depth(DepthValue(numbers))
        assert found.is_guess
        np.testing.assert_allclose(found.depth.numpy(), numbers.astype(np.float32), rtol=1e-6)


@pytest.mark.parametrize("size", [1e-20, 1e-30, 1e20, 1e30, 1e36])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_impossible_depths_are_refused_in_a_line(size: float, dtype: Any) -> None:
    numbers = (truth().astype(np.float64) * size).astype(dtype)
    with pytest.raises(InputError, match=r"hardly metres|which nothing in a photo has"):
        load_depth(DepthValue(numbers))
    with pytest.raises(InputError, match="which nothing in a photo has: give `depth_unit`"):
        load_depth(DepthValue(numbers), kind="metric")


def same_depth(found: DepthMap, expected: Floats, tolerance: float = 0) -> None:
    np.testing.assert_allclose(found.depth.numpy(), expected, rtol=tolerance)
    np.testing.assert_array_equal(found.valid.numpy(), expected > 0)


def test_depth_as_a_value_is_read_like_its_file(tmp_path: Path) -> None:
    depth = truth()
    same_depth(load_depth(DepthValue(depth)), depth)
    for shape in ((1, 40, 64), (40, 64, 1), (1, 1, 40, 64)):
        same_depth(load_depth(DepthValue(torch.from_numpy(depth).reshape(shape))), depth)
        write_npy(tmp_path / "d", depth.reshape(shape))
        same_depth(load_depth(tmp_path / "d"), depth)
    same_depth(load_depth(DepthValue(torch.from_numpy(depth).bfloat16())), depth, 1 / 128)
    same_depth(load_depth(DepthValue(Image.fromarray(depth))), depth)

    millimetres = whole(1000 * depth)
    write_png(tmp_path / "d", millimetres)
    expected = load_depth(tmp_path / "d")
    as_integers = Image.fromarray(millimetres.astype(np.int32))
    assert as_integers.mode == "I"
    for picture in (Image.fromarray(millimetres), as_integers):
        found = load_depth(DepthValue(picture))
        assert torch.equal(found.depth, expected.depth)
        assert found.quantum == expected.quantum == 0.001

    # A grey picture with channels, as OpenCV reads a grey file.
    greys = whole(4 * depth, np.uint8)
    for picture in (Image.fromarray(greys), np.repeat(greys[..., None], 3, axis=-1)):
        found = load_depth(DepthValue(picture), kind="near-black")
        assert torch.equal(found.depth, load_depth(DepthValue(greys), kind="near-black").depth)
    with pytest.raises(InputError, match="a colour picture"):
        load_depth(DepthValue(np.stack([greys, greys, 255 - greys], -1)), kind="near-black")


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_masked_depth_is_unknown(dtype: Any) -> None:
    depth = truth()
    hidden = depth > 20
    masked = np.ma.masked_array(depth.astype(dtype), hidden)
    found = load_depth(DepthValue(masked), unit="m")  # integers do not say their unit
    same_depth(found, np.where(hidden, 0, depth.astype(dtype)))
    # A relative map has numbers everywhere, and so only the mask says what is unknown.
    relative = load_depth(DepthValue(masked), kind="near-black")
    np.testing.assert_array_equal(relative.valid.numpy(), ~hidden)
    # Masked numbers may be anything, such as a mark for "unknown".
    masked = np.ma.masked_array(np.where(hidden, -1, depth), hidden)
    same_depth(load_depth(DepthValue(masked)), np.where(hidden, 0, depth))


@pytest.mark.parametrize(
    ("photo", "map_size"),  # width and height
    [
        ((640, 360), (686, 392)),  # 14: iw3
        ((640, 480), (504, 364)),  # 14: Depth Anything
        ((640, 360), (504, 280)),
        ((1920, 1080), (672, 384)),  # 32: DPT
        ((4032, 3024), (512, 384)),
        ((1242, 375), (1216, 352)),  # 32: KITTI's crop
        ((360, 640), (392, 686)),
        ((640, 480), (641, 480)),
    ],
)
def test_sides_that_a_network_rounded_fit(photo: Any, map_size: Any) -> None:
    width, height = map_size
    found = load_depth(DepthValue(np.ones((height, width), np.float32)))
    found.check_aspect_ratio(photo[1], photo[0], "a.jpg")


@pytest.mark.parametrize(
    ("photo", "map_size"),
    [
        ((640, 480), (518, 518)),  # squeezed to a square
        ((640, 480), (640, 360)),
        ((1920, 1080), (1998, 1080)),  # another format of film: no multiples
        ((640, 480), (480, 640)),
        ((640, 360), (640, 384)),
        ((640, 480), (64, 64)),
        ((640, 480), (660, 480)),
    ],
)
def test_maps_of_another_shape_are_refused(photo: Any, map_size: Any) -> None:
    width, height = map_size
    found = load_depth(DepthValue(np.ones((height, width), np.float32)))
    with pytest.raises(InputError, match=f"is {width}×{height} but photo a.jpg is") as caught:
        found.check_aspect_ratio(photo[1], photo[0], "a.jpg")
    assert ("on its side: turn it upright" in str(caught.value)) == (map_size == photo[::-1])
