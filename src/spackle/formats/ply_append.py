"""Add Gaussians to a PLY file of any program, without changing a bit of those that it holds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spackle.core.gaussians import Gaussians
from spackle.formats.gaussian_columns import Floats, GaussianColumns
from spackle.formats.ply import stored_logits
from spackle.formats.ply_layout import NoGaussiansError, PlyLayout
from spackle.formats.ply_tables import PlyElement, PlyTables, with_vertex_count


def append_to_ply(source: str | os.PathLike[str], aux: Gaussians) -> bytes | None:
    """The bytes of a PLY file with more Gaussians after its own, which keep their bytes.

    All properties, comments and other tables of the file stay. Properties that are not a
    Gaussian's position, colour, opacity or shape are 0 in the new rows. Harmonics that the file has
    and the new Gaussians have not are 0, too.

    Args:
        source: a PLY file.
        aux: the Gaussians to add, in the file's world.

    Returns:
        None if the file's layout cannot hold them: a text file, a compressed one, discs, balls,
        colours that are linear or not harmonics, or fewer harmonics than the new Gaussians have.

    Raises:
        InputError: the file is no PLY file, or damaged.
    """
    tables = PlyTables(source)
    vertex = tables.movable_vertices
    if vertex is None:
        return None
    try:
        layout = PlyLayout.find(vertex.fields)
    except NoGaussiansError:
        return None
    has_linear_colors = any(element.name == "intrinsic" for element in tables.elements)
    if not _has_room(layout, aux) or has_linear_colors:
        return None

    content = Path(source).read_bytes()
    rows_end = vertex.start_byte + vertex.row_count * np.dtype(vertex.fields).itemsize
    header_end = tables.elements[0].start_byte
    header = _longer_header(content[:header_end], vertex, len(aux))
    new_rows = _rows_of(aux, vertex, layout)
    return header + content[header_end:rows_end] + new_rows + content[rows_end:]


def _has_room(layout: PlyLayout, aux: Gaussians) -> bool:
    """Whether rows of a layout can hold Gaussians."""
    has_whole_shape = len(layout.scales) == 3 and len(layout.quats) == 4
    has_own_colors = layout.largest_color is None
    has_own_opacity = layout.opacity is not None and layout.largest_opacity is None
    has_harmonics = 3 * aux.harmonics_count <= len(layout.harmonics)
    return has_whole_shape and has_own_colors and has_own_opacity and has_harmonics


def _longer_header(header: bytes, vertex: PlyElement, count: int) -> bytes:
    """The header of a file with `count` more vertices, and with a note where the new ones begin."""
    longer = with_vertex_count(header, vertex.row_count + count)
    if b"comment spackle_base" in longer:  # of an earlier fill, whose additions are not the base
        return longer
    note = f"\ncomment spackle_base {vertex.row_count}".encode()
    first_line, line_end, others = longer.partition(b"\n")
    format_line, _, rest = others.partition(b"\n")
    return first_line + line_end + format_line + note + b"\n" + rest


def _rows_of(aux: Gaussians, vertex: PlyElement, layout: PlyLayout) -> bytes:
    """The bytes of Gaussians as rows of a table."""
    columns = GaussianColumns.from_gaussians(aux)
    rows = np.zeros(len(aux), vertex.fields)

    def write(names: Sequence[str], values: Floats) -> None:
        """Write the columns of values [N, k] into the properties of k names."""
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column

    write(layout.means, columns.means)
    write(layout.colors, columns.constant_harmonics)
    write(layout.scales, columns.log_scales)
    write(layout.quats, columns.quats)
    assert layout.opacity is not None
    rows[layout.opacity] = stored_logits(columns.opacities)
    if columns.harmonics is not None:
        # The file may have harmonics of a higher degree; these stay 0.
        count = columns.harmonics.shape[1]
        count_in_file = len(layout.harmonics) // 3
        for color in range(3):
            first = color * count_in_file
            write(layout.harmonics[first : first + count], columns.harmonics[:, :, color])
    return rows.tobytes()
