"""Write Gaussians in INRIA's PLY layout, and read the layouts of many programs.

`save_ply` writes, `PlyFile` reads. `ply_tables.py` knows the container, `ply_layout.py` the
layouts.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.color import extended_srgb_to_linear, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.formats.camera_files import checked_camera
from spackle.formats.compressed_ply import (
    HARMONICS_TABLE,
    PACKED_PROPERTIES,
    decode_compressed_ply,
)
from spackle.formats.gaussian_columns import (
    MAX_BROKEN_RATIO,
    Floats,
    GaussianColumns,
    harmonics_to_srgb,
)
from spackle.formats.ply_layout import NoGaussiansError, PlyLayout, plain_name, view_harmonics
from spackle.formats.ply_tables import (
    CHUNK_TABLE,
    NewTable,
    PlyElement,
    PlyTables,
    ply_header,
)
from spackle.formats.scene_content import SceneFile, left_out_note
from spackle.formats.scene_limits import check_gaussian_count
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import atomic_path

# Tables of more rows than SHARP's camera needs, such as the faces of a mesh, are not read.
MAX_CAMERA_TABLE_ROWS = 64

# Between these bounds, the logit of an opacity is finite in float32.
MIN_OPACITY = 1e-12
MAX_OPACITY = 1 - 2.0**-24

# Gaussians are converted in blocks of this many. The last block is padded to full size, so that
# a row's bits depend neither on the rows after it nor on the number of threads.
ROWS_PER_BLOCK = 8192

# The rows of a block of Gaussians that are read.
MEANS = slice(0, 3)
COLORS = slice(3, 6)
OPACITIES = slice(6, 7)
SCALES = slice(7, 10)
QUATS = slice(10, 14)
BLOCK_HEIGHT = 14

# The properties that are written before and after those of harmonics; some viewers expect normals.
FIRST_PROPERTIES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
LAST_PROPERTIES = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]

StrPath = str | os.PathLike[str]


def save_ply(
    gaussians: Gaussians,
    path: StrPath,
    *,
    camera: Camera | None = None,
    base_count: int | None = None,
    disparity: float | None = None,
    is_metric: bool = False,
) -> None:
    """Write a binary PLY that viewers of 3D Gaussian splatting read.

    The one table, `vertex`, has float32 columns: the position x y z, a normal of zero, the
    sRGB colour as the coefficient f_dc of the constant spherical harmonic, those of the others as
    f_rest if there are any (all of red, then of green, then of blue), the opacity as its logit,
    the scales as natural logarithms, and the rotation as a unit quaternion (w, x, y, z).
    A Gaussian gives the same bytes, whatever other Gaussians the scene has. Comments in the
    header keep `camera`, `base_count`, `disparity` and `is_metric`.

    Args:
        gaussians: the scene.
        path: the file to write, whole or not at all.
        camera: the photo's camera, at the world's origin or elsewhere.
        base_count: how many Gaussians come from the photo; those that fill holes come after.
        disparity: how far to the side the camera may go, because the holes that it uncovers are
            filled; a disparity of 1 shifts the nearest surface by the picture's diagonal.
        is_metric: whether the unit of length is known to be the metre.

    Raises:
        InputError: `path` cannot be written.
        ValueError: a Gaussian is not finite.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        parts = _encode_parts(gaussians, camera, base_count, disparity, is_metric)
        file.writelines(parts)


def encode_ply(scene: SceneFile) -> bytes:
    """Encode a scene as a binary PLY file in INRIA's layout, as `save_ply` writes it.

    Raises:
        ValueError: a Gaussian is not finite.
    """
    parts = _encode_parts(
        scene.gaussians,
        scene.camera,
        scene.base_count,
        scene.disparity,
        scene.is_metric,
    )
    return b"".join(parts)


def _encode_parts(
    gaussians: Gaussians,
    camera: Camera | None,
    base_count: int | None,
    disparity: float | None,
    is_metric: bool,
) -> Iterator[bytes]:
    """Yield the header of a PLY file, and then its rows, ROWS_PER_BLOCK at a time.

    Args:
        gaussians: the scene.
        camera: the photo's camera, if it is known.
        base_count: how many Gaussians come from the photo, if it is known.
        disparity: how far to the side the camera may go, because the holes that it uncovers are
            filled; a disparity of 1 shifts the nearest surface by the picture's diagonal. None
            if it is not known.
        is_metric: whether the unit of length is known to be the metre.
    """
    rest = [f"f_rest_{index}" for index in range(3 * gaussians.harmonics_count)]
    properties = [*FIRST_PROPERTIES, *rest, *LAST_PROPERTIES]
    vertex = NewTable(name="vertex", row_count=len(gaussians), type="float", properties=properties)
    yield ply_header(
        vertex, camera=camera, base_count=base_count, disparity=disparity, is_metric=is_metric
    )

    gaussians = gaussians.detach().to("cpu", torch.float32)
    # All blocks are converted at full size, because the last bits of a result may depend on the
    # size of the array; so a row's bits do not depend on how many rows come after it.
    padding = Gaussians(
        *(torch.zeros(ROWS_PER_BLOCK, *tensor.shape[1:]) for tensor in gaussians.tensors)
    )
    # One array serves all blocks; its columns of normals stay zero.
    table = np.zeros((ROWS_PER_BLOCK, len(properties)), "<f4")
    for start in range(0, len(gaussians), ROWS_PER_BLOCK):
        block = gaussians.select(slice(start, start + ROWS_PER_BLOCK))
        missing_rows = slice(len(block), ROWS_PER_BLOCK)
        full_block = Gaussians.cat([block, padding.select(missing_rows)])
        _fill_table(table, GaussianColumns.from_gaussians(full_block))
        yield table[: len(block)].tobytes()


def _fill_table(table: Floats, columns: GaussianColumns) -> None:
    """Write N Gaussians into the rows of `table`, [N, 17] or with 3 columns more for each harmonic.

    The columns are FIRST_PROPERTIES; all harmonics of red, then of green, then of blue; and
    LAST_PROPERTIES. Normals, the columns 3 to 5, are not written: the caller has set them to zero.
    """
    table[:, 0:3] = columns.means  # x y z
    table[:, 6:9] = columns.constant_harmonics  # f_dc_0 f_dc_1 f_dc_2
    if columns.harmonics is not None:
        by_color = columns.harmonics.transpose(0, 2, 1)  # [N, 3, K]
        table[:, 9 : -len(LAST_PROPERTIES)] = by_color.reshape(len(table), -1)  # f_rest
    last_columns = table[:, -len(LAST_PROPERTIES) :]
    last_columns[:, 0] = stored_logits(columns.opacities)  # opacity
    last_columns[:, 1:4] = columns.log_scales  # scale_0 scale_1 scale_2
    last_columns[:, 4:8] = columns.quats  # rot_0 rot_1 rot_2 rot_3


def stored_logits(opacities: Floats) -> Floats:
    """The logits [N] of opacities [N], which are first moved a little away from 0 and 1."""
    clipped = np.clip(opacities, MIN_OPACITY, MAX_OPACITY)
    # Precise for opacities near 1, too, because 1 - opacity is exact there.
    logits: Floats = np.log(clipped / (1 - clipped))
    return logits


def load_ply(path: StrPath) -> Gaussians:
    """Read Gaussians from a PLY file, in any layout of `PlyFile`.

    Raises:
        InputError: the file cannot be read, holds no Gaussians, or some are not finite.
    """
    return PlyFile(path).gaussians()


class PlyFile:
    """A PLY file with Gaussians, and what Spackle or SHARP noted of the scene.

    The file may be binary, in either order of bytes, or text. Its layout may be that of INRIA and
    its many followers, of SHARP, of PlayCanvas's compressed files, of 2D Gaussian splatting (flat
    discs), or have red, green and blue in place of spherical harmonics.
    """

    def __init__(self, path: StrPath) -> None:
        """Read the header of a file; the Gaussians are read by `gaussians`.

        Raises:
            InputError: the file is no PLY file, its header is broken, or the file is too short.
        """
        self.path = path
        self._tables = PlyTables(path)
        # [rows] which rows of the file `gaussians` has returned; None: all, or none read yet.
        self.finite_rows: NDArray[np.bool_] | None = None

    def scene(self) -> SceneFile:
        """Read the Gaussians, and what the file says about the scene's camera and completion.

        Raises:
            InputError: a part of the file is invalid.
        """
        # A wrong camera is reported before the Gaussians, which take long, are read.
        camera = self.camera()
        base_count = self.base_count()
        disparity = self.disparity()
        notes = self._notes()
        gaussians = self.gaussians()
        broken_count = self._vertex_element().row_count - len(gaussians)
        if broken_count:
            notes = (*notes, left_out_note(broken_count))
        return SceneFile(
            path=Path(self.path),
            gaussians=gaussians,
            camera=camera,
            base_count=base_count,
            disparity=disparity,
            is_metric=self.is_metric(),
            format=self._format(),
            writer=self._tables.generator,
            harmonics_degree=self._harmonics_degree(),
            notes=notes,
            byte_count=self._tables.file_bytes,
        )

    def _format(self) -> str:
        """Return what the file's format is called."""
        if self._tables.is_compressed:
            return "compressed PLY"
        return "text PLY" if self._tables.is_text else "PLY"

    def _harmonics_degree(self) -> int:
        """Return the degree of the file's spherical harmonics."""
        # The properties f_rest_0, f_rest_1, … are coefficients: for each degree up to d there are
        # (d + 1)² - 1 of each colour. A compressed file has them in a table of their own.
        count = 0
        for element in self._tables.elements:
            names = [plain_name(name) for name in element.property_names]
            count += sum(name.startswith("f_rest_") for name in names)
        return math.isqrt(count // 3 + 1) - 1

    def _notes(self) -> tuple[str, ...]:
        """Return what had to be assumed about the Gaussians."""
        if self._tables.is_compressed:
            return ()
        return PlyLayout.find(self._vertex_element().fields).notes

    def gaussians(self) -> Gaussians:
        """Read the Gaussians, with linear RGB colours.

        The properties may have any order and type. Spherical harmonics (f_rest) are read up to
        degree 3.

        A few Gaussians that are not finite, which training leaves behind, are left out; of a scene
        that Spackle completed, none is.

        Raises:
            InputError: there are no Gaussians, or too many contain NaN or inf. An infinite logit
                of an opacity is allowed: SHARP writes one for an opacity of 1.
        """
        vertex = self._vertex_element()
        with as_input_error(self.path, "not a Gaussian scene: {reason}", ValueError):
            check_gaussian_count(
                vertex.row_count, self._harmonics_degree(), self._tables.file_bytes
            )
        if self._tables.is_compressed:
            return self._compressed_gaussians(vertex)

        count = vertex.row_count
        layout = PlyLayout.find(vertex.fields)
        rows = self._tables.rows(vertex)
        are_linear = self._are_colors_linear()
        means = torch.empty(count, 3)
        colors = torch.empty(count, 3)
        opacities = torch.empty(count, 1)  # with two axes, as the other tensors have
        scales = torch.empty(count, 3)
        quats = torch.empty(count, 4)
        # SHARP's linear colours have none, and a sum in sRGB would not fit them.
        harmonics = None
        if layout.harmonics and not are_linear:
            harmonics = torch.empty(count, len(layout.harmonics) // 3, 3)
        # Which rows of the block below go into each tensor.
        groups = [
            (means, MEANS),
            (colors, COLORS),
            (opacities, OPACITIES),
            (scales, SCALES),
            (quats, QUATS),
        ]

        # One array serves all blocks; a row holds one property.
        block = np.zeros((BLOCK_HEIGHT, ROWS_PER_BLOCK), np.float32)
        is_finite = np.empty(count, bool)
        for start in range(0, count, ROWS_PER_BLOCK):
            block_rows = rows[start : start + ROWS_PER_BLOCK]
            stop = start + len(block_rows)
            is_finite[start:stop] = _convert_block(
                block, block_rows, layout, are_linear, has_harmonics=harmonics is not None
            )
            if harmonics is not None:
                block_harmonics = layout.read_view_harmonics(block_rows)
                is_finite[start:stop] &= np.isfinite(block_harmonics).all(axis=(1, 2))
                harmonics[start:stop] = torch.from_numpy(block_harmonics)
            for tensor, group in groups:
                tensor[start:stop] = torch.from_numpy(block[group, : len(block_rows)].T)

        gaussians = Gaussians(means, quats, scales, opacities[:, 0], colors, harmonics)
        broken_count = count - int(np.count_nonzero(is_finite))
        if broken_count == 0:
            return gaussians
        # The numbers of base and aux Gaussians would no longer fit a scene of Spackle.
        if broken_count > MAX_BROKEN_RATIO * count or self.base_count() is not None:
            problem = f"{broken_count} of {count} Gaussians are not finite"
            raise InputError(f"{self.path}: {problem}: export it again")
        self.finite_rows = is_finite
        return gaussians.select(torch.from_numpy(is_finite))

    def camera(self) -> Camera | None:
        """Read the photo's camera.

        `save_ply` stores it in the comments "spackle_camera" and, if it is not at the world's
        origin, "spackle_pose". SHARP, another program that turns a
        photo into Gaussians, stores it in the tables "intrinsic", "extrinsic" and "image_size".

        Returns:
            The camera; None if the file has none.

        Raises:
            InputError: the stored camera is impossible.
        """
        # The principal point of a cropped photo may be negative.
        numbers = self._tables.numbers_in_comment("spackle_camera", count=6, lowest=-math.inf)
        if numbers is not None:
            fx, fy, cx, cy, width, height = numbers
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            pose = np.eye(4)
            rows = self._tables.numbers_in_comment("spackle_pose", count=12, lowest=-math.inf)
            if rows is not None:
                pose[:3] = np.reshape(rows, (3, 4))
            return self._checked_camera(K, pose, width, height)

        extras = self._small_columns()
        if "intrinsic" not in extras:
            return None
        missing = np.empty(0)
        intrinsic = extras["intrinsic"]
        extrinsic = extras.get("extrinsic", missing)
        image_size = extras.get("image_size", missing)
        # A 3×3 matrix, a 4×4 matrix, and width and height.
        if (len(intrinsic), len(extrinsic), len(image_size)) != (9, 16, 2):
            problem = "the stored camera is not as SHARP writes it"
            raise InputError(f"{self.path}: {problem}: give the focal length")
        width, height = image_size
        return self._checked_camera(intrinsic.reshape(3, 3), extrinsic.reshape(4, 4), width, height)

    def base_count(self) -> int | None:
        """Read how many Gaussians come from the photo; those that fill holes come after them.

        Returns:
            The number; None for files of other programs.

        Raises:
            InputError: the stored number is negative, or larger than that of all Gaussians.
        """
        count = self._vertex_element().row_count
        numbers = self._tables.numbers_in_comment("spackle_base", count=1, highest=count)
        return None if numbers is None else int(numbers[0])

    def disparity(self) -> float | None:
        """Read how far to the side the camera may go: so far are the holes it uncovers filled.

        Returns:
            The distance as a disparity, of which 1 shifts the nearest surface by the picture's
            diagonal; None for files of other programs.

        Raises:
            InputError: the stored value is not a number, or negative.
        """
        numbers = self._tables.numbers_in_comment("spackle_disparity", count=1)
        return None if numbers is None else numbers[0]

    def is_metric(self) -> bool:
        """Whether the file says that its unit of length is the metre.

        Raises:
            InputError: the comment that says so does not hold a number.
        """
        numbers = self._tables.numbers_in_comment("spackle_metric", count=1)
        return numbers is not None and numbers[0] == 1

    def _vertex_element(self) -> PlyElement:
        """Return the table of the vertices, which are the Gaussians.

        Raises:
            InputError: there is not exactly one such table, its vertices are not Gaussians, or
                there are none, or they have no fixed size.
        """
        elements = self._tables.elements_named("vertex")
        if len(elements) != 1:
            problem = f"holds {len(elements)} elements called vertex"
            raise InputError(f"{self.path}: {problem}: not a Gaussian scene")
        vertex = elements[0]

        if self._tables.is_compressed:
            present = vertex.property_names
            missing = [name for name in PACKED_PROPERTIES if name not in present]
            if missing:
                problem = f"its vertices have no {', '.join(missing)}"
                raise InputError(f"{self.path}: not a Gaussian scene: {problem}")
            if len(self._tables.elements_named(CHUNK_TABLE)) != 1:
                problem = "its vertices are packed, and the table of their chunks is missing"
                raise InputError(f"{self.path}: {problem}: export the scene again")
        else:
            with as_input_error(self.path, "not a Gaussian scene: {reason}", NoGaussiansError):
                PlyLayout.find(vertex.fields)

        advice = "export it as a plain Gaussian scene"
        if vertex.row_count == 0:
            raise InputError(f"{self.path}: holds no Gaussians: {advice}")
        if not self._tables.has_known_place(vertex):
            raise InputError(f"{self.path}: holds lists in or before its vertices: {advice}")
        return vertex

    def _compressed_gaussians(self, vertex: PlyElement) -> Gaussians:
        """Decode PlayCanvas's compressed layout; `vertex` is the table of the Gaussians."""
        # The bounds within which the vertices are stored.
        (chunk,) = self._tables.elements_named(CHUNK_TABLE)
        problem = "the compressed tables cannot be read: {reason}: export the scene again"
        with as_input_error(self.path, problem):
            chunk_rows = self._tables.rows(chunk)
            harmonics = self._compressed_harmonics(vertex.row_count)
            columns = decode_compressed_ply(chunk_rows, self._tables.rows(vertex), harmonics)
            return columns.to_gaussians()

    def _compressed_harmonics(self, count: int) -> NDArray[np.uint8] | None:
        """Return the bytes [count, 3·K] of the harmonics in a compressed file; None without any.

        Raises:
            ValueError: the table has another number of rows than there are Gaussians.
        """
        for element in self._tables.elements_named(HARMONICS_TABLE):
            stored_names = {name: name for name in element.property_names}
            names = view_harmonics(stored_names)
            if not names or not self._tables.has_known_place(element):
                continue
            if element.row_count != count:
                raise ValueError(f"{element.row_count} rows of harmonics for {count} Gaussians")
            rows = self._tables.rows(element)
            return np.stack([rows[name].astype(np.uint8) for name in names], axis=1)
        return None

    def _are_colors_linear(self) -> bool:
        """Return whether the stored colours are linear RGB; else they are sRGB.

        SHARP's `color_space` says so: 0 for sRGB, 1 for linear. An older file of SHARP has no
        `color_space`, but a camera; SHARP reads its colours as linear. All other programs store
        sRGB.
        """
        extras = self._small_columns()
        if "color_space" in extras:
            return bool(extras["color_space"].any())
        return "intrinsic" in extras

    def _small_columns(self) -> dict[str, NDArray[np.float64]]:
        """Read the small tables after the Gaussians, in which SHARP stores its camera."""
        return self._tables.small_columns(MAX_CAMERA_TABLE_ROWS)

    def _checked_camera(
        self, K: NDArray[Any], world_to_camera: NDArray[Any], width: float, height: float
    ) -> Camera:
        """Return a camera from the numbers in the file.

        Args:
            K: [3, 3] float64 intrinsics in pixels.
            world_to_camera: [4, 4] float64 pose.
            width, height: size in pixels.

        Raises:
            InputError: the camera is impossible.
        """
        # A size that is no whole number becomes 0, which `checked_camera` refuses.
        whole_width = int(width) if float(width).is_integer() else 0
        whole_height = int(height) if float(height).is_integer() else 0
        return checked_camera(
            torch.from_numpy(K),
            torch.from_numpy(world_to_camera),
            whole_width,
            whole_height,
            f"{self.path}: the stored camera",
        )


def _convert_block(
    block: Floats,
    rows: NDArray[Any],
    layout: PlyLayout,
    are_linear: bool,
    *,
    has_harmonics: bool,
) -> NDArray[np.bool_]:
    """Convert rows of a PLY file to means, linear colours, opacities, scales and quaternions.

    Args:
        block: [14, ROWS_PER_BLOCK] takes the result: one number of a Gaussian a row, one Gaussian a
            column. Only the first len(rows) columns are meaningful. The others are computed, too,
            because the last bits of a result may depend on the size of the array; so a Gaussian
            gets the same bits, however many others are in its block.
        rows: at most ROWS_PER_BLOCK rows of the table, with a field for each property.
        layout: names the properties.
        are_linear: whether the colours are linear RGB; else they are sRGB.
        has_harmonics: whether the view changes the colours, which are then not clamped.

    Returns:
        [len(rows)] which of the Gaussians are finite.
    """
    count = len(rows)
    block[MEANS, :count] = layout.read_means(rows)
    block[COLORS, :count] = layout.read_harmonics(rows)
    block[OPACITIES, :count] = layout.read_logits(rows)
    block[SCALES, :count] = layout.read_log_scales(rows)
    block[QUATS, :count] = layout.read_quats(rows)
    # Numbers beyond float32 become infinite, and are counted below.
    with np.errstate(over="ignore", invalid="ignore"):
        block[SCALES] = np.exp(block[SCALES])
        rgb = torch.from_numpy(harmonics_to_srgb(block[COLORS]))
    block[OPACITIES] = torch.from_numpy(block[OPACITIES]).sigmoid()

    # The colours are checked before their conversion, which would make infinite ones finite.
    is_finite = np.asarray(np.isfinite(block[:, :count]).all(axis=0))
    decode = extended_srgb_to_linear if has_harmonics else srgb_to_linear
    block[COLORS] = rgb.clamp_min(0) if are_linear else decode(rgb)
    return is_finite
