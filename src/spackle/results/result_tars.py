"""Tars of the results of so many photos each, in place of a folder for each photo.

Photos are grouped in their order. Their results are written into folders of `staging/`; once all
photos of a group are done, their files become a tar, and the folders go. A tar is whole or absent,
and its bytes depend on its photos' files alone, so that a run that was killed ends with the same
tars. Names in it follow WebDataset: "a/x.scene.ply" is the file scene.ply of the photo "a/x".
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tarfile
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

from spackle.results.photo_folder import REPORT_NAME
from spackle.results.photo_names import NamedPhoto
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import atomic_path, remove_half_written

STAGING_NAME = "staging"
FILE_MODE = 0o644  # of files in a tar: everybody may read them


def key_of(photo_name: str) -> str:
    """What the names of a photo's files in a tar begin with.

    WebDataset ends it at the first dot behind the last slash, so dots there become "%2E", and the
    percent sign "%25", as in addresses.
    """
    folder, slash, last = photo_name.rpartition("/")
    return folder + slash + last.replace("%", "%25").replace(".", "%2E")


class ResultTars:
    """The tars of a run; each is written in a thread, once all its photos are done."""

    def __init__(self, output: Path, photos: Sequence[NamedPhoto], size: int) -> None:
        """Look which tars there are.

        Args:
            output: the folder of the tars, which this run has locked.
            photos: all photos of the run.
            size: number of photos of a tar; the last one may have fewer.
        """
        self.staging = output / STAGING_NAME
        self._output = output
        self._photos = photos
        self._size = size
        self._remaining_counts: list[int] = []  # photos of each tar that are not done yet
        self._in_tar = bytearray(len(photos))  # 1: an earlier run has put its results into the tar
        remove_half_written(output)  # such as the tar that a killed run was writing
        self._present = set(os.listdir(output))
        # The reports in the tar that was asked for last, with their sizes, by the photos' keys.
        self._reports_tar = ""
        self._reports: dict[str, tuple[dict[str, Any], int]] = {}
        self._thread = ThreadPoolExecutor(1)
        self._writes: list[Future[None]] = []

    def __enter__(self) -> ResultTars:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for the tars that are being written."""
        self._thread.shutdown(wait=True)
        if error is None:
            for write in self._writes:
                write.result()  # raises the error of a tar that could not be written
        # Folders of photos that are not in a tar yet stay.
        for place, _, _ in os.walk(self.staging, topdown=False):
            with contextlib.suppress(OSError):
                os.rmdir(place)

    def name_of(self, photo: NamedPhoto) -> str:
        """The name of the tar that a photo's results belong to."""
        return f"results-{photo.number // self._size:06d}.tar"

    def exists(self, photo: NamedPhoto) -> bool:
        """Whether an earlier run has written the tar that a photo's results belong to."""
        return self.name_of(photo) in self._present

    def check_same_place(self, photo: NamedPhoto, line: dict[str, Any]) -> None:
        """InputError if an earlier run has put a photo into another tar, by its line."""
        if line.get("tar", self.name_of(photo)) != self.name_of(photo):
            raise InputError(
                f"{self._output}: {photo.name} is in {line['tar']}, and would now belong into "
                f"{self.name_of(photo)}: give the same `tar` and the same photos, to which others "
                "may be added at the end, or another `output`"
            )

    def report_of(self, photo: NamedPhoto) -> tuple[dict[str, Any], int]:
        """The report of a photo in its tar, which exists, and its size in bytes.

        The report is empty if the photo is not in the tar.

        InputError if the tar cannot be read, or holds other photos.
        """
        name = self.name_of(photo)
        if name != self._reports_tar:
            self._reports = self._read_reports(name)
            self._reports_tar = name
        return self._reports.get(key_of(photo.name), ({}, 0))

    def keep(self, photo: NamedPhoto) -> None:
        """Note that a photo's results in its tar are up to date."""
        self._in_tar[photo.number] = 1

    def begin(self, unfinished: Iterable[NamedPhoto]) -> None:
        """Note which photos are still to be done, and write the tars of which none is."""
        group_count = -(-len(self._photos) // self._size)  # rounded up
        self._remaining_counts = [0] * group_count
        for photo in unfinished:
            self._remaining_counts[photo.number // self._size] += 1
        # A run that was killed may have left the folders of a whole group.
        if self.staging.is_dir():
            for group, count in enumerate(self._remaining_counts):
                if count == 0:
                    self._writes.append(self._thread.submit(self._write, group))

    def photo_done(self, photo: NamedPhoto) -> None:
        """Note that a photo was completed, or has failed; the last one of a tar has it written.

        InputError if an earlier tar could not be written.
        """
        for write in [write for write in self._writes if write.done()]:
            write.result()
            self._writes.remove(write)
        group = photo.number // self._size
        self._remaining_counts[group] -= 1
        if self._remaining_counts[group] == 0:
            self._writes.append(self._thread.submit(self._write, group))

    def _group(self, group: int) -> Sequence[NamedPhoto]:
        """The photos of a tar."""
        return self._photos[group * self._size : (group + 1) * self._size]

    def _read_reports(self, name: str) -> dict[str, tuple[dict[str, Any], int]]:
        """The reports in a tar with their sizes, by their photos' keys; see `report_of`."""
        group = int(name.removeprefix("results-").removesuffix(".tar"))
        keys = {key_of(photo.name) for photo in self._group(group)}
        path = self._output / name
        reports: dict[str, tuple[dict[str, Any], int]] = {}
        ending = f".{REPORT_NAME}"
        with (
            as_input_error(path, "cannot be read: {reason}: delete it, and it is made again"),
            tarfile.open(path) as tar,
        ):
            for member in tar:
                file = tar.extractfile(member) if member.name.endswith(ending) else None
                if file is None:
                    continue
                key = member.name.removesuffix(ending)
                if key not in keys:
                    raise InputError(
                        f"{path}: holds {key}, which is not among its photos: give the same `tar` "
                        "and the same photos, or another `output`"
                    )
                reports[key] = (json.loads(file.read()), member.size)
        return reports

    def _write(self, group: int) -> None:
        """Write a tar of what its photos have in staging and of what the tar has already.

        InputError if it cannot be written.
        """
        photos = self._group(group)
        staged = [photo for photo in photos if (self.staging / photo.name / REPORT_NAME).exists()]
        # All photos may have failed, or be in the tar already.
        if not staged:
            self._remove_staged(photos)
            return
        path = self._output / self.name_of(photos[0])
        with contextlib.ExitStack() as stack:
            stack.enter_context(as_input_error(path, "cannot be written: {reason}", OSError))
            earlier: tarfile.TarFile | None = None
            kept_members: dict[str, list[tarfile.TarInfo]] = {}
            if any(self._in_tar[photo.number] for photo in photos):
                earlier = stack.enter_context(tarfile.open(path))
                for member in earlier:
                    folder, slash, last = member.name.rpartition("/")
                    key = folder + slash + last.partition(".")[0]
                    kept_members.setdefault(key, []).append(member)

            temporary = stack.enter_context(atomic_path(path))
            tar = stack.enter_context(tarfile.open(temporary, "w", format=tarfile.PAX_FORMAT))
            staged_numbers = {photo.number for photo in staged}
            for photo in photos:
                key = key_of(photo.name)
                if photo.number in staged_numbers:
                    _add_folder(tar, key, self.staging / photo.name)
                elif earlier is not None and self._in_tar[photo.number]:
                    for member in kept_members.get(key, []):
                        tar.addfile(member, earlier.extractfile(member))
        self._remove_staged(photos)

    def _remove_staged(self, photos: Sequence[NamedPhoto]) -> None:
        """Remove what is in staging of photos that are all done, also what a kill has left."""
        for photo in photos:
            shutil.rmtree(self.staging / photo.name, ignore_errors=True)


def _add_folder(tar: tarfile.TarFile, key: str, folder: Path) -> None:
    """Add the files of a photo's folder to a tar, sorted by name.

    Times and owners are left out, so that the bytes of the tar depend on the files alone.
    """
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = file.relative_to(folder).as_posix().replace("/", ".")
        member = tarfile.TarInfo(f"{key}.{name}")
        member.size = file.stat().st_size
        member.mode = FILE_MODE
        with open(file, "rb") as content:
            tar.addfile(member, content)
