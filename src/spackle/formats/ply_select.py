"""Take Gaussians out of a PLY file of any program, without changing a bit of those that stay."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from spackle.formats.ply import PlyFile
from spackle.formats.ply_tables import PlyTables, with_vertex_count


def select_in_ply(source: str | os.PathLike[str], is_kept: Tensor) -> bytes | None:
    """The bytes of a PLY file with some of its Gaussians, whose rows keep their bytes.

    All properties, comments and other tables of the file stay. Rows that are not read because they
    are not finite stay, too. The comment that says how many Gaussians come from a photo counts
    those that are left.

    Args:
        source: a PLY file.
        is_kept: [N] bool, of the Gaussians as they are read from the file.

    Returns:
        None if rows of the file cannot be taken out: a text file, or a compressed one.

    Raises:
        InputError: the file is no PLY file, or damaged.
    """
    tables = PlyTables(source)
    vertex = tables.movable_vertices
    if vertex is None:
        return None

    keeps_row = _kept_rows(source, vertex.row_count, is_kept)
    content = Path(source).read_bytes()
    row_bytes = np.dtype(vertex.fields).itemsize
    rows_end = vertex.start_byte + vertex.row_count * row_bytes
    rows = np.frombuffer(content[vertex.start_byte : rows_end], np.uint8).reshape(-1, row_bytes)
    header_end = tables.elements[0].start_byte
    before_rows = content[header_end : vertex.start_byte]
    header = _shorter_header(content[:header_end], keeps_row)
    return header + before_rows + rows[keeps_row].tobytes() + content[rows_end:]


def _kept_rows(
    source: str | os.PathLike[str], row_count: int, is_kept: Tensor
) -> NDArray[np.bool_]:
    """[rows] bool: the rows of a file that stay; those that are not read stay."""
    kept = is_kept.cpu().numpy()
    if row_count == len(kept):
        return kept
    file = PlyFile(source)
    file.gaussians()
    assert file.finite_rows is not None  # some rows were left out
    keeps_row = np.ones(row_count, np.bool_)
    keeps_row[file.finite_rows] = kept
    return keeps_row


def _shorter_header(header: bytes, keeps_row: NDArray[np.bool_]) -> bytes:
    """The header of a file with fewer vertices, of which fewer come from the photo."""

    def count_of_base(match: re.Match[bytes]) -> bytes:
        """The comment with the number of Gaussians of the photo that are kept."""
        count = int(np.count_nonzero(keeps_row[: int(match.group(2))]))
        return match.group(1) + str(count).encode()

    shorter = with_vertex_count(header, int(np.count_nonzero(keeps_row)))
    return re.sub(
        rb"(\n[ \t]*comment[ \t]+spackle_base[ \t]+)(\d+)", count_of_base, shorter, count=1
    )
