"""Read depth maps: metres in NumPy, PNG, PFM or EXR, Middlebury's disparities, and relative depth in any picture."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
import re
import zipfile
from pathlib import Path
from typing import IO, Any, Literal, get_args

import av
import numpy as np
import torch
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_files import check_pixel_count, read_image
from spackle.runtime.errors import InputError, as_input_error, short_repr
from spackle.runtime.files import check_file

Array = NDArray[Any]
StrPath = str | os.PathLike[str]
Quantity = Literal["depth", "disparity"]
# The meaning of a file's numbers. near-white: inverse depth, near-black: depth, both up to scale and shift.
DepthKind = Literal["auto", "metric", "disparity", "near-white", "near-black"]
DEPTH_KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
RELATIVE: tuple[DepthKind, ...] = ("near-white", "near-black")

SUFFIXES = (".npy", ".npz", ".png", ".pfm", ".exr")
EXR_MAGIC = b"\x76\x2f\x31\x01"
EXR_ROWS = {
    0: 1,
    1: 1,
    2: 1,
    3: 16,
    4: 32,
}  # rows in a block, by compression: FFmpeg decodes some others wrongly
MAX_TEXT_BYTES = 1 << 16  # a calibration is a few lines
PNG_UNIT_M = 0.001
LARGEST = 1e9  # largest number in a calibration: the square of 1e9 still fits float32
ASPECT_TOLERANCE = 0.01
CALIBRATED_SIZE_TOLERANCE = 0.02
NEAREST_M = 1.5  # distance of the nearest surface if depth is relative
NEAREST_QUANTILE = 0.999  # of inverse depth, as for trajectories; nearer pixels are specks
MIN_DISTINCT = 16  # fewer distinct values may share a divisor by chance
FAR_M = 15.0  # where the farthest surface of a relative map is placed
EXTREMES = (0.01, 0.99)  # quantiles that count as the nearest and the farthest depth
STRETCH = 4.0  # depths beyond the extremes are limited to this factor nearer or farther
FILLED = 0.05  # a 16-bit PNG is a relative map if its values come this close (as a share) to both ends of the range
GREY = 8  # of 255: the channels of a grey picture differ by less, even after lossy compression
WHICH = "give --depth-kind near-white (as MiDaS, Depth Anything and ComfyUI write it), near-black or metric"


@dataclasses.dataclass(frozen=True)
class DepthMap:
    """A depth map as it was stored: neither filled nor cleaned."""

    depth: Tensor  # [H, W] float32 z in metres; 0 where not valid
    valid: Tensor  # [H, W] bool
    K: Tensor | None  # [3, 3] intrinsics in pixels of this map, from the map's calibration
    quantum: float | None  # quantisation step: metres for depth, 1/m for disparity
    quantity: Quantity  # the stored quantity
    path: Path
    note: str = ""  # for the report: the format of a depth map that was inside a photo

    @property
    def range_in_words(self) -> str:
        near, middle, far = np.quantile(
            self.depth[self.valid].numpy(), [EXTREMES[0], 0.5, EXTREMES[1]]
        )
        return f"{near:.3g} m near, {middle:.3g} m median, {far:.3g} m far"

    def check_shape(self, height: int, width: int, photo: StrPath) -> None:
        """InputError unless a height×width photo has this map's aspect ratio within 1 %."""
        rows, columns = self.depth.shape
        if abs(columns * height / (rows * width) - 1) > ASPECT_TOLERANCE:
            raise InputError(
                f"depth map {self.path} is {columns}×{rows} but photo {photo} is {width}×{height}: "
                "give a depth map with the photo's size or aspect ratio"
            )

    def with_focal(self, focal_px: float) -> DepthMap:
        """The map with another focal length, in pixels of the map; depths computed from disparity are scaled too."""
        if (
            self.K is None or self.quantity == "depth"
        ):  # measured metres do not depend on the focal length
            return dataclasses.replace(self, K=None)
        # depth = baseline · focal / disparity
        K, ratio = self.K.clone(), focal_px / float(self.K[0, 0])
        K[0, 0] = K[1, 1] = focal_px
        quantum = self.quantum and self.quantum / ratio
        return dataclasses.replace(self, depth=self.depth * ratio, K=K, quantum=quantum)


def find_depth(depth: Path, photo: Path) -> Path:
    """The file `depth`, or the depth map with the photo's name in the folder `depth`; InputError if it is missing."""
    if not os.path.isdir(depth):
        return depth
    for name in (
        photo.name,
        photo.stem,
    ):  # a.jpg.npy before a.npy, because a.npy may belong to a.png
        for suffix in SUFFIXES:
            candidate = depth / f"{name}{suffix}"
            if os.path.isfile(candidate) and candidate.resolve() != photo.resolve():
                return candidate
    names = ", ".join(f"{photo.stem}{suffix}" for suffix in SUFFIXES)
    raise InputError(f"{photo}: no depth map in {depth}: looked for {names}")


def load_depth(
    path: StrPath,
    *,
    focal_px: float | None = None,
    calib: StrPath | None = None,
    kind: DepthKind = "auto",
    near: float = NEAREST_M,
    far: float = FAR_M,
) -> DepthMap:
    """Read a depth map, a disparity map with its calibration, or a relative map.

    Depth is stored in metres in `.npy`, `.npz` (one array, or the key `depth`), `.pfm` and `.exr` (the channel depth,
    Z, V, Y or R): 0, NaN and inf mean unknown. A 16-bit `.png` stores millimetres: 0 and 65535 mean unknown. The
    content decides the format.

    Disparity d becomes depth = baseline · focal / (d + doffs); inf (in a PNG also 0) means unknown. A file holds
    disparity if `calib` is given, if a `scene.json` in the same folder names the file as its `disparity`, or if the
    file's name starts with "disp" and the same folder has a Middlebury `calib.txt`.

    Besides these formats, a relative map may be any grey picture; see `relative_depth`.

    Args:
        path: the file.
        focal_px: replaces the calibration's focal length, in pixels of the map.
        calib: a Middlebury `calib.txt` or a `scene.json`.
        kind: meaning of the numbers; auto means disparity under the conditions above, else metric, never relative.
        near: nearest depth of a relative map, in metres.
        far: farthest depth of a relative map, in metres.

    InputError for a map that is missing, broken, too large, misshapen, negative or entirely unknown; also if `kind` is
    auto and the map looks relative.
    """
    check_file(path, "depth map")
    if focal_px is not None and not 1 / LARGEST <= focal_px <= LARGEST:
        raise InputError(f"--focal-px {focal_px:g}: give a focal length above 0, in pixels")
    if kind in RELATIVE:
        stored, _ = read_array(path, grey=True)
        return relative_depth(stored, kind, path, near, far)
    lens = None if kind == "metric" else _find_calibration(Path(path), calib)
    if kind == "disparity" and lens is None:
        raise InputError(
            f"{path}: its folder has no calibration: give --calib FILE, or --depth-kind near-white"
        )
    if lens and focal_px is not None:
        lens = dataclasses.replace(lens, focal_px=focal_px)
    stored, is_png = read_array(path)
    if kind == "auto" and lens is None and is_png and _fills_16_bits(stored):
        raise InputError(
            f"{path}: its values fill the range of 16 bits, as relative depth does: {WHICH}"
        )
    return _depth_map(stored, is_png, lens, Path(path))


def depth_of_array(stored: Array, path: Path, kind: DepthKind = "auto") -> DepthMap:
    """A depth map from an array [H, W] of metres (0, NaN, inf: unknown) or relative values; messages name `path`."""
    if stored.ndim != 2 or not stored.size or stored.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: an array of {stored.dtype} {short_repr(stored.shape)}: give [height, width] in metres"
        )
    return (
        relative_depth(stored, kind, path)
        if kind in RELATIVE
        else _depth_map(stored, False, None, path)
    )


def _depth_map(stored: Array, is_png: bool, lens: Calibration | None, path: Path) -> DepthMap:
    values = np.where(np.isfinite(stored), stored, 0)
    if negative := int((values < 0).sum()):
        raise InputError(
            f"{path}: {negative} of {values.size} values are negative: mark unknown pixels with 0 or NaN"
        )
    quantity: Quantity = "depth" if lens is None else "disparity"
    depth, valid, unit = (
        _as_disparity(stored, is_png, lens, path) if lens else _as_depth(stored, is_png, path)
    )
    with np.errstate(over="ignore"):  # a depth too large for float32 becomes inf, hence unknown
        metres = torch.from_numpy(depth.astype(np.float32))
    known = torch.from_numpy(valid) & is_depth(metres)
    if not known.any():
        raise InputError(f"{path}: all-invalid: not one of {values.size} pixels has a {quantity}")
    integers = (
        stored.dtype.kind in "iu" or lens is not None
    )  # floats that happen to be whole metres have no step
    step = grid_step(values[known.numpy()]) if integers else None
    quantum = None if step is None else step * unit
    return DepthMap(
        metres.where(known, 0.0), known, None if lens is None else lens.K, quantum, quantity, path
    )


def relative_depth(
    stored: Array,
    kind: DepthKind,
    path: StrPath,
    near: float = NEAREST_M,
    far: float = FAR_M,
    step: float | None = None,
) -> DepthMap:
    """Convert inverse depth (near-white) or depth (near-black) [H, W] of unknown scale and shift to metres.

    The 1 % and 99 % quantiles become `near` and `far`; NaN and inf mean unknown. `step` is the quantisation step of
    `stored`. InputError (naming `path`) if nearly all depths are equal, or if not 0 < `near` < `far`.
    """
    if not 0 < near < far < LARGEST:
        raise InputError(
            f"--near {near:g}, --far {far:g}: give two distances in metres, the nearer one first"
        )
    values, known = stored.astype(np.float64), np.isfinite(stored)
    low, high = np.quantile(values[known], EXTREMES) if known.any() else (0.0, 0.0)
    if not high > low:
        raise InputError(f"{path}: the depth is the same nearly everywhere: give another depth map")
    share = (np.where(known, values, low) - low) / (high - low)
    if kind == "near-white":
        unit = (1 / near - 1 / far) / (high - low)
        depth = 1 / np.clip(
            1 / far + share * (1 / near - 1 / far), 1 / (STRETCH * far), STRETCH / near
        )
    else:
        unit = (far - near) / (high - low)
        depth = np.clip(near + share * (far - near), near / STRETCH, STRETCH * far)
    if step is None and stored.dtype.kind in "iu":
        step = grid_step(values[known])
    quantity: Quantity = "disparity" if kind == "near-white" else "depth"
    metres, valid = torch.from_numpy(depth.astype(np.float32)), torch.from_numpy(known)
    return DepthMap(
        metres.where(valid, 0.0), valid, None, step and step * unit, quantity, Path(path)
    )


def nearest(values: Tensor) -> Tensor:
    """The inverse depth [] that is placed at `NEAREST_M`: a high quantile of `values` [N]."""
    return values.kthvalue(1 + round(NEAREST_QUANTILE * (len(values) - 1))).values


def _fills_16_bits(stored: Array) -> bool:
    known = stored[(stored > 0) & (stored < 65535)]
    return bool(known.size and known.min() < FILLED * 65535 and known.max() > (1 - FILLED) * 65535)


def is_depth(metres: Tensor) -> Tensor:
    """Mask of valid depths: positive and finite, with a finite inverse."""
    return torch.isfinite(metres) & (metres > 0) & torch.isfinite(1 / metres)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A rectified stereo pair: the left camera, and the conversion from disparity to depth."""

    focal_px: float
    cx: float
    cy: float
    doffs_px: float
    baseline_m: float
    scale: float = 1.0  # disparity in pixels = stored value · scale
    invalid: float = math.inf  # stored value for "unknown"
    size: tuple[int, int] | None = None  # (width, height) of the image that the numbers describe

    @property
    def K(self) -> Tensor:
        """[3, 3] intrinsics of the left camera, in pixels."""
        return torch.tensor(
            [[self.focal_px, 0.0, self.cx], [0.0, self.focal_px, self.cy], [0.0, 0.0, 1.0]]
        )

    def depth(self, disparity: Array, path: Path) -> DepthMap:
        """The depth map of an array of disparities in pixels; 0 or less: unknown."""
        return _depth_map(np.where(disparity > 0, disparity, np.inf), False, self, path)

    def cameras(self, width: int, height: int) -> tuple[Camera, Camera]:
        """The cameras of the left and the right photo, in the left camera's frame."""
        K, pose = self.K, torch.eye(4)
        K[0, 2] += self.doffs_px
        pose[0, 3] = -self.baseline_m
        return Camera(self.K, torch.eye(4), width, height), Camera(K, pose, width, height)

    def check(self, path: StrPath) -> Calibration:
        """Return this calibration; InputError, naming the file, if its numbers are impossible."""
        positive, others = (
            (self.focal_px, self.baseline_m, self.scale),
            (self.cx, self.cy, self.doffs_px),
        )
        if not all(1 / LARGEST <= n <= LARGEST for n in positive) or not all(
            abs(n) <= LARGEST for n in others
        ):
            raise InputError(f"{path}: a number is not positive, or is above {LARGEST:g}")
        return self


def calibrations_beside(path: Path) -> tuple[Path, Path]:
    """Paths at which a map's calibration is searched for, existing or not: scene.json, calib.txt."""
    return path.with_name("scene.json"), path.with_name("calib.txt")


def read_calibration(path: StrPath) -> Calibration:
    """A stereo pair's calibration from a `scene.json` or Middlebury's `calib.txt`; InputError for another file."""
    lens = _read_scene(path, None) if Path(path).suffix.lower() == ".json" else None
    return lens or _read_calib(path)


def _find_calibration(path: Path, calib: StrPath | None) -> Calibration | None:
    if calib is not None:
        return read_calibration(calib)
    (scene, text), stem = calibrations_beside(path), path.stem.lower()
    if scene.is_file() and (lens := _read_scene(scene, path.name)):
        return lens
    if stem.startswith("disp") and text.is_file():
        return _read_calib(text)
    if stem.startswith("disp") or stem.endswith(("disp", "disparity")):
        raise InputError(
            f"{path}: the name announces a disparity map: give --calib, or rename the map"
        )
    return None


def _read_calib(path: StrPath) -> Calibration:
    """Read Middlebury's text: cam0=[f 0 cx; 0 f cy; 0 0 1], doffs in pixels, baseline in millimetres."""
    pairs = (line.partition("=") for line in read_text(path).splitlines())
    entries = {name.strip(): value.strip() for name, _, value in pairs}
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    with as_input_error(
        path, "not a Middlebury calibration: needs cam0=[f 0 cx; 0 f cy; 0 0 1], doffs and baseline"
    ):
        focal, _, cx, _, _, cy, *_ = (float(n) for n in re.findall(number, entries["cam0"]))
        lens = Calibration(
            focal, cx, cy, float(entries.get("doffs", 0)), float(entries["baseline"]) / 1000
        )
        if "width" in entries and "height" in entries:
            lens = dataclasses.replace(lens, size=(int(entries["width"]), int(entries["height"])))
    return lens.check(path)


def _read_scene(path: StrPath, disparity: str | None) -> Calibration | None:
    """Read a `scene.json`; None if it describes another file than `disparity`."""
    needs = "needs focal_px, cx, cy, doffs_px and baseline_m as JSON numbers"
    with as_input_error(path, f"not a scene description: {needs}"):
        scene = json.loads(read_text(path))
        if disparity is not None and scene.get("disparity") != disparity:
            return None
        focal, cx, cy, doffs, baseline = (
            float(scene[k]) for k in ("focal_px", "cx", "cy", "doffs_px", "baseline_m")
        )
        scale, invalid = float(scene.get("disparity_scale", 1)), float(scene.get("invalid", "inf"))
        return Calibration(focal, cx, cy, doffs, baseline, scale, invalid).check(path)


def read_text(path: StrPath, kind: str = "calibration", at_most: int = MAX_TEXT_BYTES) -> str:
    """Read a short text file; InputError if it is missing, or has more than `at_most` bytes."""
    if check_file(path, kind) > at_most:
        raise InputError(f"{path}: too long for a {kind}: give another file")
    return Path(path).read_text(encoding="utf-8", errors="replace")


def _as_depth(stored: Array, is_png: bool, path: StrPath) -> tuple[Array, Array, float]:
    """Depth in metres, its validity, and the unit of stored values in metres."""
    if is_png:
        if stored.dtype == np.uint8:
            advice = "give 16 bits, or --depth-kind near-white or near-black"
            raise InputError(f"{path}: an 8-bit PNG holds no metres: {advice}")
        return stored * PNG_UNIT_M, stored != 65535, PNG_UNIT_M
    if stored.dtype.kind in "iu" and np.median(stored) > 500:
        raise InputError(
            f"{path}: integers around {np.median(stored):.0f} are hardly metres: divide them by 1000"
        )
    return stored, np.isfinite(stored), 1.0


def _as_disparity(
    stored: Array, is_png: bool, lens: Calibration, path: StrPath
) -> tuple[Array, Array, float]:
    """Depth in metres, its validity, and the unit of stored values in 1/m."""
    height, width = stored.shape
    if (
        lens.size
        and max(abs(lens.size[0] / width - 1), abs(lens.size[1] / height - 1))
        > CALIBRATED_SIZE_TOLERANCE
    ):
        calibrated = f"{lens.size[0]}×{lens.size[1]}"
        raise InputError(
            f"{path}: {width}×{height} pixels, its calibration is for {calibrated}: give matching files"
        )
    valid = np.isfinite(stored) & (stored != lens.invalid)
    if is_png:
        valid &= stored > 0
    with np.errstate(all="ignore"):  # the caller marks infinite results
        depth = (
            lens.baseline_m
            * lens.focal_px
            / (stored.astype(np.float64) * lens.scale + lens.doffs_px)
        )
    return depth, valid & np.isfinite(depth), lens.scale / (lens.baseline_m * lens.focal_px)


def grid_step(values: Array) -> float | None:
    """The step of the integer grid on which all values lie; None if a value is not an integer."""
    if float(values.max()) > 1 << 53 or not np.array_equal(values, np.round(values)):
        return None
    distinct = np.unique(values.astype(np.int64))
    return float(np.gcd.reduce(np.diff(distinct))) if len(distinct) >= MIN_DISTINCT else 1.0


def read_array(path: StrPath, *, grey: bool = False) -> tuple[Array, bool]:
    """The stored numbers [H, W] of a depth map, and whether the file is a PNG; InputError for an unknown format.

    With `grey`, other picture formats are read too, and three nearly equal channels count as one.
    """
    readers = {b"\x93NUM": _read_npy, b"PK\x03\x04": _read_npz, EXR_MAGIC: _read_exr}
    with (
        as_input_error(path, "cannot be decoded ({reason}): the file is damaged or cut off"),
        open(path, "rb") as file,
    ):
        start = file.read(4)
        file.seek(0)
        if start.startswith(b"\x89PNG"):
            return read_image(path, lambda image: _png_values(image, path, grey)), True
        if start.startswith(b"PF"):
            raise InputError(
                f"{path}: a PFM with three channels is not a depth map: give one channel (Pf)"
            )
        if start.startswith(b"Pf"):
            return read_image(path, lambda image: np.array(image)), False
        if read := readers.get(start):
            return read(file, path), False
    if grey:
        return read_image(path, lambda image: _png_values(image, path, grey)), False
    raise InputError(
        f"{path}: not a depth map: give .npy, .npz, .pfm or .exr in metres, or a 16-bit .png in millimetres"
    )


def _check_size(shape: tuple[int, ...], path: StrPath) -> None:
    if len(shape) != 2 or min(shape) < 1:
        raise InputError(
            f"{path}: an array of shape {shape} is not a depth map: give [height, width]"
        )
    check_pixel_count(shape[1], shape[0], os.path.getsize(path), path)


def _png_values(image: Image.Image, path: StrPath, grey: bool) -> Array:
    _check_size((image.height, image.width), path)
    if grey and image.mode != "L" and not image.mode.startswith("I"):
        channels = np.asarray(image.convert("RGB")).astype(np.int16)
        if np.ptp(channels, axis=-1).max() >= GREY:
            raise InputError(
                f"{path}: a colour picture does not tell near from far: give a grey one"
            )
        return channels[..., 1].astype(np.uint8)
    if image.mode != "L" and not image.mode.startswith("I"):
        raise InputError(f"{path}: a PNG with mode {image.mode} holds no millimetres: {WHICH}")
    values = np.asarray(image)
    return values if image.mode == "L" else values.astype(np.uint16)


def _read_npy(file: IO[bytes], path: StrPath) -> Array:
    """Read one array without unpickling; the header's size must match the bytes that the file holds."""
    start = io.BytesIO(file.read(1 << 16))  # a damaged header may announce 4 GB of itself
    old = np.lib.format.read_magic(start) == (1, 0)
    read_header = (
        np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = read_header(start)
    if dtype.kind not in "fiu":
        raise InputError(f"{path}: an array of {dtype} is not a depth map: give float32 metres")
    _check_size(shape, path)
    count = math.prod(shape)
    values = np.frombuffer(start.read() + file.read(count * dtype.itemsize), dtype, count)
    return np.ascontiguousarray(
        values.reshape(shape, order="F" if fortran else "C"), dtype.newbyteorder("=")
    )


def _read_npz(file: IO[bytes], path: StrPath) -> Array:
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
        if len(names) != 1 and "depth.npy" not in names:
            raise InputError(
                f"{path}: holds {len(names)} arrays and none is called depth: name one of them depth"
            )
        with archive.open("depth.npy" if "depth.npy" in names else names[0]) as member:
            return _read_npy(member, path)


def _read_exr(file: IO[bytes], path: StrPath) -> Array:
    """Read the channel depth, Z, V, Y or R by FFmpeg, which knows only Y: the last letters of names are changed."""
    data, at, header = bytearray(file.read()), 8, dict[bytes, slice]()
    if data[5] & 0x1A:
        raise InputError(
            f"{path}: a tiled or deep EXR, or one with several parts: give one plain picture"
        )
    while data[at]:
        name, kind, _ = data[at : at + 600].split(b"\0", 2)
        start = at + len(name) + len(kind) + 6
        at = start + int.from_bytes(data[start - 4 : start], "little")
        header[bytes(name)] = slice(start, at)
    (compression,), listed = data[header[b"compression"]], header[b"channels"]
    if compression not in EXR_ROWS:
        raise InputError(
            f"{path}: an EXR with lossy or new compression: save it with ZIP or PIZ, or uncompressed"
        )
    left, top, right, bottom = np.frombuffer(data[header[b"displayWindow"]], "<i4").tolist()
    _check_size((bottom - top + 1, right - left + 1), path)
    _, top, _, bottom = np.frombuffer(data[header[b"dataWindow"]], "<i4").tolist()
    last = int(
        np.frombuffer(data, "<u8", (bottom - top) // EXR_ROWS[compression] + 1, at + 1).max()
    )
    if last + 8 + int.from_bytes(data[last + 4 : last + 8], "little") > len(
        data
    ):  # FFmpeg would read zeros
        raise EOFError("the last rows are missing")
    channels = list(re.finditer(rb"([^\0]+)\0.{16}", data[listed], re.DOTALL))
    # The shortest of several names: Z, not Normal.Z.
    depth = max(
        channels,
        key=lambda each: (b"depth" in each[1].lower(), b"RYVZ".find(each[1][-1:]), -len(each[1])),
    )
    for channel in channels:
        data[listed.start + channel.end(1) - 1] = ord("Y" if channel is depth else "?")
    decoder = VideoCodecContext.create("exr", "r")
    decoder.options = {
        "layer": depth[1][:-1].decode(),
        "threads": "1",
    }  # threads would live as long as an error
    picture = decoder.decode(av.Packet(bytes(data)))[0]
    if picture.format.name not in ("grayf16le", "grayf32le"):
        raise InputError(f"{path}: an EXR of integers: give metres as half or float")
    pixel = np.dtype("<f2" if "16" in picture.format.name else "<f4")
    return np.frombuffer(bytes(picture.planes[0]), pixel).reshape(picture.height, -1)[
        :, : picture.width
    ]
