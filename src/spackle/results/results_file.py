"""results.jsonl: what became of each photo of a run over many, one line of JSON for each.

While a run is at work, a line is added when a photo is done; at the end the lines come into the
order of the photos. The next run reads it to know at once what is done already.
"""

from __future__ import annotations

import itertools
import json
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from spackle.runtime.errors import as_input_error
from spackle.runtime.files import atomic_path

RESULTS_NAME = "results.jsonl"
NO_LINE = -1  # in place of a position in the file: nothing is known of the photo


class ResultsFile:
    """The file results.jsonl during a run, with the last line of each photo.

    In memory there is one number for each photo, so that a million photos need 8 MB.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        """Open the file of a folder, or create it when the first line is added.

        Args:
            folder: that of the results, which this run has locked.
            names: of all photos of this run, in their order.

        Raises:
            InputError: the file cannot be read.
        """
        self.path = folder / RESULTS_NAME
        self._names = names
        # Where the last line about each photo begins, in bytes from the start of the file.
        self._positions = array("q", [NO_LINE]) * len(names)
        # The same for photos that are not in this run, but were in an earlier one.
        self._other_positions: dict[str, int] = {}
        self._file: IO[bytes] | None = None
        self._size = 0  # of the file, in bytes
        if self.path.exists():
            with as_input_error(self.path, "cannot be read: {reason}", OSError):
                self._file = open(self.path, "rb+")  # noqa: SIM115 (closed by `__exit__`)
                self._read_positions(self._file)

    def __enter__(self) -> ResultsFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Bring the lines into the order of the photos, also if the run was stopped."""
        if self._file is None:
            return
        try:
            self._sort(self._file)
        finally:
            self._file.close()

    def line_of(self, index: int) -> dict[str, Any]:
        """The last line about the photo of this number; empty if there is none."""
        position = self._positions[index]
        if self._file is None or position == NO_LINE:
            return {}
        self._file.seek(position)
        line: dict[str, Any] = json.loads(self._file.readline())
        return line

    def add(self, index: int, line: Mapping[str, Any]) -> None:
        """Add a line about the photo of this number, which replaces an earlier one.

        InputError if it cannot be written.
        """
        content = json.dumps(line, allow_nan=False).encode() + b"\n"
        with as_input_error(self.path, "cannot be written: {reason}", OSError):
            if self._file is None:
                self._file = open(self.path, "wb+")  # noqa: SIM115 (closed by `__exit__`)
            # Whoever looks into the file, and the next run after a kill, finds whole lines.
            self._file.seek(self._size)
            self._file.write(content)
            self._file.flush()
        self._positions[index] = self._size
        self._size += len(content)

    def _read_positions(self, file: IO[bytes]) -> None:
        """Note where the last line of each photo begins.

        Damaged lines count as missing. Half a line at the end, which a power cut may leave, is cut
        off.
        """
        index_of = {name: index for index, name in enumerate(self._names)}
        for content in file:
            position = self._size
            if not content.endswith(b"\n"):
                file.truncate(position)
                break
            self._size += len(content)
            try:
                name = json.loads(content)["name"]
            except (ValueError, TypeError, KeyError):
                continue
            if not isinstance(name, str):
                continue
            if name in index_of:
                self._positions[index_of[name]] = position
            else:
                self._other_positions[name] = position

    def _sort(self, file: IO[bytes]) -> None:
        """Write the last line of each photo in the order of the photos, whole or not at all.

        Photos of earlier runs that are not in this one stand before them.
        """
        # A file that is sorted already, as after a run with nothing to do, stays as it is.
        known = [position for position in self._positions if position != NO_LINE]
        wanted = [*self._other_positions.values(), *known]
        is_sorted = all(first < second for first, second in itertools.pairwise(wanted))
        line_count = 0
        file.seek(0)
        for _ in file:
            line_count += 1
        if is_sorted and line_count == len(wanted):
            return
        with atomic_path(self.path) as temporary, open(temporary, "wb") as sorted_file:
            for position in wanted:
                file.seek(position)
                sorted_file.write(file.readline())
