"""Gaussians as PLY: plain INRIA files out, INRIA's and SHARP's in, their headers checked before anything is read."""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Iterator
from typing import IO, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.camera import Camera
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.errors import InputError, reason_in_a_line
from spackle.files import atomic_path, check_file
from spackle.formats.camera_files import checked_camera
from spackle.gaussians import Gaussians

MAX_HEADER_BYTES = 1 << 16
MAX_EXTRA_ROWS = 64  # SHARP's elements after the vertices hold at most 16 numbers

_NAMES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
_SIZED = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
_CODES = dict(zip([*_NAMES, *_SIZED], ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"] * 2, strict=True))
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)
SMALLEST_OPACITY, LARGEST_OPACITY = 1e-12, 1 - 2.0**-24  # keep the logit finite
SMALLEST_SCALE, LARGEST_SCALE = 1e-37, 1e37  # keep the logarithm, and float32 after it, finite
SMALLEST_QUAT = 1e-12  # a shorter quaternion has no direction

# One block fits the cache, and torch computes so few numbers in one thread. Blocks are always full: so a row's
# bits depend neither on the rows after it nor on the number of threads. log and exp are NumPy's, because
# torch splits even these; waiting for a second thread a thousand times is slow on a busy machine.
BLOCK = 8192

_READ = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
_READ += ["rot_0", "rot_1", "rot_2", "rot_3"]
_WRITTEN = [*_READ[:3], "nx", "ny", "nz", *_READ[3:]]

# Comments of the header, which other readers pass over: the photo's camera, how many Gaussians are the base's, and how
# far to the side the scene was completed.
CAMERA_COMMENT = "spackle_camera"  # fx fy cx cy width height
BASE_COMMENT = "spackle_base"
DISPARITY_COMMENT = "spackle_disparity"


@torch.no_grad()
def save_ply(
    gaussians: Gaussians,
    path: str | os.PathLike[str],
    *,
    camera: Camera | None = None,
    base_count: int | None = None,
    disparity: float | None = None,
) -> None:
    """Write a binary PLY that viewers of 3D Gaussian splatting read.

    One `vertex` element of float32: x y z, normals of zero, f_dc from the sRGB colour, opacity as
    logit, scales as logarithm, rot as unit quaternion wxyz. Row i depends on Gaussian i alone.

    Args:
        gaussians: the scene.
        path: the file.
        camera: the photo's camera, at the world's origin; kept in a comment for `load_ply_camera`.
        base_count: how many of the first Gaussians are the base's; kept in a comment likewise.
        disparity: how far the scene was completed, see `spackle.camera_path.max_offset`; likewise.

    Raises:
        InputError: where nothing can be written at `path`.
        ValueError: where a Gaussian is not finite.
    """
    count = len(gaussians)
    lines = ["ply", "format binary_little_endian 1.0", *header_comments(camera, base_count, disparity)]
    lines.append(f"element vertex {count}")
    lines += [*(f"property float {name}" for name in _WRITTEN), "end_header", ""]
    columns = [t.detach().to("cpu", torch.float32).contiguous() for t in gaussians.tensors]
    table = np.zeros((BLOCK, len(_WRITTEN)), "<f4")
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode())
        for start in range(0, count, BLOCK):
            rows = min(BLOCK, count - start)
            _encode([_padded(c[start : start + rows]) for c in columns], table)
            if not np.isfinite(table[:rows]).all():
                raise ValueError(f"{path}: Gaussians {start} to {start + rows - 1} are not all finite")
            file.write(table[:rows].data)


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from an INRIA or SHARP file, binary or ASCII; colours become linear RGB.

    Properties may come in any order and type; spherical harmonics above degree 0 (f_rest) are passed
    over. SHARP's `color_space` says whether colours are sRGB (0) or linear (1). Without it, a file with
    SHARP's camera is linear, as SHARP reads it, and any other sRGB.

    Raises:
        InputError: a missing, broken or cut file, one without Gaussians, or one with NaN or inf. An
            infinite opacity logit is allowed: SHARP writes one for an opacity of 1.
    """
    size = check_file(path, "PLY file")
    with open(path, "rb") as file:
        header = read_header(file, path)
        header.check_size(size)
        vertex, offset = _vertex(header)
        extras = read_extras(file, header)
        linear = bool(extras["color_space"].any()) if "color_space" in extras else "intrinsic" in extras
        parts = [torch.empty(vertex.count, width) for width in (3, 4, 3, 1, 3)]
        broken = 0
        for start, table in _tables(file, header, vertex, offset):
            broken += _decode(table, [part[start : start + BLOCK] for part in parts], linear)
    if broken:
        raise InputError(f"{path}: {broken} of {vertex.count} Gaussians are not finite: export the scene again")
    return Gaussians(parts[0], parts[1], parts[2], parts[3][:, 0], parts[4])


def load_ply_camera(path: str | os.PathLike[str]) -> Camera | None:
    """The photo's camera that SHARP stores after the Gaussians, or `save_ply` in a comment; None in other files.

    Raises:
        InputError: a broken file, or a camera that makes no sense.
    """
    header, words = _comment(path, CAMERA_COMMENT)
    where = f"{path}: the stored camera"
    K, matrix = np.eye(3), np.eye(4)
    if words is not None:
        try:
            K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height = (float(word) for word in words)
            return checked_camera(torch.from_numpy(K), torch.from_numpy(matrix), int(width), int(height), where)
        except (ValueError, OverflowError) as error:
            raise InputError(f"{where} makes no sense: {error}") from error
    with open(path, "rb") as file:
        extras = read_extras(file, header)
    if "intrinsic" not in extras:
        return None
    intrinsic, extrinsic = extras["intrinsic"], extras.get("extrinsic", np.eye(4).ravel())
    if len(intrinsic) == 9 and len(extras.get("image_size", ())) == 2:
        K, (width, height) = intrinsic.reshape(3, 3), extras["image_size"]
    elif len(intrinsic) == 4:  # older: fx, fy, width, height
        K[0, 0], K[1, 1], width, height = intrinsic
        K[:2, 2] = width / 2, height / 2
    else:
        raise InputError(f"{path}: a camera of {len(intrinsic)} numbers is none of SHARP's: give the focal length")
    if len(extrinsic) == 12:  # older: 3×4 with the rotation transposed
        matrix[:3] = extrinsic.reshape(3, 4)
        matrix[:3, :3] = matrix[:3, :3].T.copy()
    elif len(extrinsic) == 16:
        matrix = extrinsic.reshape(4, 4)
    width, height = (int(side) if float(side).is_integer() else 0 for side in (width, height))
    return checked_camera(torch.from_numpy(K), torch.from_numpy(matrix), width, height, where)


def load_ply_base_count(path: str | os.PathLike[str]) -> int | None:
    """How many of the first Gaussians are the base's, as `save_ply` was told; None in other files.

    Raises:
        InputError: a broken file, or a number that makes no sense.
    """
    header, words = _comment(path, BASE_COMMENT)
    if words is None:
        return None
    vertex, _ = _vertex(header)
    if len(words) != 1 or not re.fullmatch(r"[0-9]{1,12}", words[0]) or int(words[0]) > vertex.count:
        raise InputError(f"{path}: the stored number of base Gaussians makes no sense: {' '.join(words)[:80]}")
    return int(words[0])


def load_ply_disparity(path: str | os.PathLike[str]) -> float | None:
    """How far the scene was completed, as `save_ply` was told; None in other files.

    Raises:
        InputError: a broken file, or a number that makes no sense.
    """
    _, words = _comment(path, DISPARITY_COMMENT)
    if words is None:
        return None
    try:
        (value,) = (float(word) for word in words)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise InputError(f"{path}: the stored disparity makes no sense: {' '.join(words)[:80]}")
    return value


def header_comments(camera: Camera | None, base_count: int | None, disparity: float | None) -> list[str]:
    """Header lines that keep the photo's camera, which stands at the world's origin, and the two numbers."""
    lines = []
    if camera is not None:
        numbers = [*camera.focal, *camera.K[:2, 2].tolist(), camera.width, camera.height]
        lines.append(" ".join(["comment", CAMERA_COMMENT, *(repr(number) for number in numbers)]))
    if base_count is not None:
        lines.append(f"comment {BASE_COMMENT} {base_count}")
    if disparity is not None:
        lines.append(f"comment {DISPARITY_COMMENT} {disparity!r}")
    return lines


def _comment(path: str | os.PathLike[str], name: str) -> tuple[Header, list[str] | None]:
    """The header of a file that is long enough for it, and the words of its comment of that name; None without one."""
    size = check_file(path, "PLY file")
    with open(path, "rb") as file:
        header = read_header(file, path)
    header.check_size(size)
    return header, header.comments.get(name)


def _padded(part: Tensor) -> Tensor:
    """A full block, [BLOCK, ...]; the surplus is computed and thrown away."""
    if len(part) == BLOCK:
        return part
    return torch.cat([part, torch.zeros(BLOCK - len(part), *part.shape[1:])])


def _encode(columns: list[Tensor], table: NDArray[np.float32]) -> None:
    """Fill `table` [BLOCK, 17] from means, quats, scales, opacities, colours; the normals stay 0."""
    means, quats, scales, opacities, colors = columns
    table[:, 0:3] = means.numpy()
    table[:, 6:9] = ((linear_to_srgb(colors) - 0.5) / SH_C0).numpy()
    o = np.clip(opacities.numpy(), SMALLEST_OPACITY, LARGEST_OPACITY)
    table[:, 9] = np.log(o / (1 - o))  # 1 - o is exact above one half
    table[:, 10:13] = np.log(np.clip(scales.numpy(), SMALLEST_SCALE, LARGEST_SCALE))
    quats = quats / quats.abs().amax(-1, keepdim=True).clamp_min(1.0)  # their squares may be too large
    norm = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    table[:, 13:17] = (quats / norm.clamp_min(SMALLEST_QUAT)).numpy()
    table[norm[:, 0].numpy() < SMALLEST_QUAT, 13] = 1.0


def _vertex(header: Header) -> tuple[Element, int]:
    """The vertices and their offset; InputError where they are not Gaussians of a fixed size."""
    path = header.path
    named = [element for element in header.elements if element.name == "vertex"]
    if len(named) != 1:
        raise InputError(f"{path}: holds {len(named)} elements called vertex instead of one: not a Gaussian scene")
    missing = [name for name in _READ if name not in dict(named[0].fields)]
    if missing:
        raise InputError(f"{path}: not a Gaussian scene: its vertices have no {', '.join(missing)}")
    for element, offset in header.readable():
        if element is named[0] and element.count:
            return element, offset
    problem = "no Gaussians" if named[0].count == 0 else "lists in or before its vertices"
    raise InputError(f"{path}: holds {problem}: export it as a plain Gaussian scene")


def _tables(file: IO[bytes], header: Header, vertex: Element, offset: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """First row and the properties of `_READ` [14, BLOCK], overwritten by the next; the last has a surplus."""
    table = np.zeros((len(_READ), BLOCK), np.float32)
    file.seek(header.data_start + (0 if header.ascii else offset))
    if header.ascii:
        skip_lines(file, offset)
    for start in range(0, vertex.count, BLOCK):
        count = min(BLOCK, vertex.count - start)
        if header.ascii:
            rows = read_lines(file, vertex, count, header.path)
        else:
            rows = np.fromfile(file, vertex.dtype, count)
            if len(rows) < count:
                raise InputError(f"{header.path}: cut off while it was read: try again")
        with np.errstate(over="ignore", invalid="ignore"):  # too large for float32 becomes inf, which is counted
            for k, name in enumerate(_READ):
                table[k, :count] = rows[name]
        yield start, table


def _decode(table: NDArray[np.float32], parts: list[Tensor], linear: bool) -> int:
    """Fill means, quats, scales, opacities, colours [rows, …] from [14, BLOCK]; the number of broken rows."""
    means, quats, scales, opacities, colors = parts
    rows = len(means)
    rgb = torch.from_numpy(table[3:6] * np.float32(SH_C0) + np.float32(0.5))
    colors.copy_((rgb.clamp_min(0) if linear else srgb_to_linear(rgb))[:, :rows].T)
    opacities.copy_(torch.from_numpy(table[6:7]).sigmoid()[:, :rows].T)
    with np.errstate(over="ignore", invalid="ignore"):
        table[7:10] = np.exp(table[7:10])
    for part, first in ((means, 0), (scales, 7), (quats, 10)):
        part.copy_(torch.from_numpy(table[first : first + part.shape[1], :rows]).T)
    table[6][np.isinf(table[6])] = 0  # a sigmoid of 0 or 1
    fine = np.isfinite(table[:, :rows])
    return 0 if fine.all() else int((~fine.all(axis=0)).sum())


@dataclasses.dataclass
class Element:
    """One table of a PLY file."""

    name: str
    count: int
    fields: list[tuple[str, str]] = dataclasses.field(default_factory=list)  # (name, NumPy type)
    has_list: bool = False  # rows have no fixed size

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.fields)


@dataclasses.dataclass(frozen=True)
class Header:
    """The elements in file order, and where their data begins."""

    ascii: bool
    elements: list[Element]
    data_start: int  # bytes
    path: str | os.PathLike[str]
    comments: dict[str, list[str]] = dataclasses.field(default_factory=dict)  # first word → the others

    def readable(self) -> list[tuple[Element, int]]:
        """Elements up to the first one without a fixed size, each with its offset from `data_start`.

        The offset counts bytes, or lines in an ASCII file.
        """
        offset, found = 0, []
        for element in self.elements:
            if element.has_list:
                break
            found.append((element, offset))
            offset += element.count * (1 if self.ascii else element.dtype.itemsize)
        return found

    def check_size(self, file_size: int) -> None:
        """InputError where the file is too short for its tables; nothing has been allocated yet."""
        for element, offset in self.readable():
            # A number and its separator take two characters at least.
            row = 2 * len(element.fields) if self.ascii else element.dtype.itemsize
            needed = (0 if self.ascii else offset) + element.count * row
            if self.data_start + needed - self.ascii > file_size:
                raise InputError(
                    f"{self.path}: cut off: {element.count} rows of {element.name!r} are announced, "
                    f"but the file ends after {file_size} bytes"
                )


def read_header(file: IO[bytes], path: str | os.PathLike[str]) -> Header:
    """Parse the header of a PLY file that is open at its start.

    Raises:
        InputError: not a PLY file, or a header that is endless or makes no sense.
    """
    head = file.read(MAX_HEADER_BYTES)
    if head.split(b"\n", 1)[0].rstrip() != b"ply":
        raise InputError(f"{path}: not a PLY file: its first line must be 'ply'")
    lines: list[list[str]] = []
    start = 0
    while not lines or lines[-1] != ["end_header"]:
        end = head.find(b"\n", start) + 1
        if end == 0:
            raise InputError(f"{path}: the header has no end: the file is damaged or cut off")
        lines.append(head[start:end].decode("latin-1").split())
        start = end
    try:
        order, elements = _parse(lines[1:-1])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: broken PLY header: {reason_in_a_line(error)}") from error
    comments = {words[1]: words[2:] for words in lines if words[:1] == ["comment"] and len(words) > 1}
    return Header(order == "=", elements, start, path, comments)


def _parse(lines: list[list[str]]) -> tuple[str, list[Element]]:
    """Byte order and elements; ValueError, KeyError or IndexError where a line makes no sense."""
    order = ""
    elements: list[Element] = []
    for words in lines:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if int(count) >= 0:
                elements.append(Element(name, int(count)))
            case ["property", "list", _, _, _]:
                elements[-1].has_list = True
            case ["property", kind, name] if order:
                elements[-1].fields.append((name, order + _CODES[kind]))
            case _:
                raise ValueError(f"cannot understand the line {' '.join(words)[:80]!r}")
    for element in elements:
        np.dtype(element.fields)  # ValueError for a name given twice
    if not order:
        raise ValueError("there is no format line")
    return order, elements


def read_extras(file: IO[bytes], header: Header) -> dict[str, NDArray[np.float64]]:
    """The small tables of a binary or ASCII file, property name → numbers, such as SHARP's camera."""
    extras: dict[str, NDArray[np.float64]] = {}
    line = 0
    file.seek(header.data_start)
    for element, offset in header.readable():
        small = element.name != "vertex" and element.count <= MAX_EXTRA_ROWS and bool(element.fields)
        if small and header.ascii:
            skip_lines(file, offset - line)
            rows = read_lines(file, element, element.count, header.path)
            line = offset + element.count
        elif small:
            file.seek(header.data_start + offset)
            rows = np.frombuffer(file.read(element.count * element.dtype.itemsize), element.dtype)
        if small:
            extras |= {name: rows[name].astype(np.float64) for name, _ in element.fields}
    return extras


def skip_lines(file: IO[bytes], count: int) -> None:
    """Pass over the rows of an ASCII table."""
    for _ in range(count):
        if not file.readline():
            return  # whoever reads on finds the end


def read_lines(file: IO[bytes], element: Element, count: int, path: str | os.PathLike[str]) -> NDArray[Any]:
    """`count` rows of an ASCII table as a structured array of float64.

    Raises:
        InputError: a row with too few or too many numbers, or with something else.
    """
    columns = len(element.fields)
    words = b" ".join(file.readline(MAX_HEADER_BYTES) for _ in range(count)).split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: {element.name!r} holds something that is no number: {error}") from error
    if len(numbers) != count * columns:
        raise InputError(f"{path}: {element.name!r} is cut off or has rows without exactly {columns} numbers")
    return numbers.view([(name, "f8") for name, _ in element.fields])
