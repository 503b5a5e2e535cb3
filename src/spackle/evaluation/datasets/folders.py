"""Where a dataset's scenes are below a folder, and which dataset a folder looks like."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.files import files_in
from spackle.image import PHOTO_SUFFIXES

MAX_DEPTH = 4  # of a scene below the root; the deepest official one is root/train/balanced/SCENE
MAX_FOLDERS = 100_000  # opened in search of scenes; WildRGB-D has 23,000 of them
GUESS_FOLDERS = 300  # opened to guess what a folder is instead

LLFF_SCENES = {"fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"}
TANKS_SCENES = {
    *("barn", "caterpillar", "church", "courthouse", "ignatius", "meetingroom", "truck"),
    *("family", "francis", "horse", "lighthouse", "m60", "panther", "playground", "train"),
    *("auditorium", "ballroom", "courtroom", "museum", "palace", "temple"),
}
_TWO_VIEW = re.compile(r"_\d[ls]$")  # of ETH3D: playground_1l, electro_2s


@dataclasses.dataclass(frozen=True)
class Layout:
    """How a dataset's folders are known."""

    expected: str  # what is looked for, for messages
    is_scene: Callable[[Path], bool]
    skip: frozenset[str] = frozenset()  # folders that are passed over: no truth, or the same photos again


def scene_folders(root: Path, dataset: str) -> list[Path]:
    """The scenes of a dataset at or below `root`, by their names.

    Raises:
        InputError: no such folder, or no scene of the dataset in it; the message names what was expected.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder: give the one that {dataset} was unpacked in")
    if root.name in ("", ".."):  # a scene is called like its folder
        root = root.resolve()
    layout = LAYOUTS[dataset]
    found = sorted(_walk(root, layout, MAX_FOLDERS), key=lambda folder: (folder.name, folder.as_posix()))
    if not found:
        # The dataset that has most scenes there, after a short look.
        counts = {name: sum(1 for _ in _walk(root, other, GUESS_FOLDERS)) for name, other in LAYOUTS.items()}
        likely = max(counts, key=lambda name: counts[name])
        hint = f"; this looks like {likely}" if counts[likely] else ""
        raise InputError(f"{root}: no scene of {dataset} at or below it: expected {layout.expected}{hint}")
    return found


def by_name(scenes: Sequence[Path], name: Callable[[Path], str] = lambda scene: scene.name) -> dict[str, Path]:
    """Scenes by their names; InputError where two share one, as the sizes of one photo do."""
    named: dict[str, Path] = {}
    for folder in scenes:
        other = named.setdefault(name(folder), folder)
        if other is not folder:
            raise InputError(f"{folder}: {other} is called the same: give the folder of one size or part alone")
    return named


def photo_files(folder: Path) -> list[Path]:
    """The photos right in a folder, by name; none where there is no folder."""
    return files_in(folder, PHOTO_SUFFIXES) if folder.is_dir() else []


def _walk(root: Path, layout: Layout, budget: int) -> Iterator[Path]:
    """Scenes in breadth-first order; what lies inside a scene is none."""
    level = [root]
    for depth in range(MAX_DEPTH + 1):
        below: list[Path] = []
        for folder in level:
            if layout.is_scene(folder):
                yield folder
            elif depth < MAX_DEPTH and budget > 0:
                budget -= 1
                with contextlib.suppress(OSError), os.scandir(folder) as entries:  # no right to look into it
                    names = [entry.name for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
                    below += [folder / name for name in sorted(names) if name not in layout.skip]
        level = below


def _has(folder: Path, *names: str) -> bool:
    return any((folder / name).exists() for name in names)


def _called(folder: Path, scenes: set[str]) -> bool:
    return not scenes.isdisjoint(re.split(r"[_\-. ]", folder.name.lower()))


def _is_tanks(folder: Path) -> bool:
    other = _has(folder, "poses_bounds.npy") or _called(folder, LLFF_SCENES)
    return _has(folder, "sparse", "dense/sparse") and (_called(folder, TANKS_SCENES) or not other)


def is_two_view(folder: Path) -> bool:
    """A rectified pair of ETH3D's, in Middlebury's format: by its name, or because COLMAP's files are beside it."""
    return _has(folder, "im0.png") and (bool(_TWO_VIEW.search(folder.name)) or _has(folder, "cameras.txt"))


def _is_eth3d(folder: Path) -> bool:
    multi = _has(folder, "dslr_calibration_undistorted", "dslr_calibration_jpg", "images/dslr_images_undistorted")
    return multi or is_two_view(folder)


def _is_middlebury(folder: Path) -> bool:
    old = _has(folder, "view1.png", "im2.ppm", "im2.png") or (_has(folder, "disp1.png") and _has(folder, "dmin.txt"))
    new = _has(folder, "im0.png") and not folder.name.startswith("camera_")  # as Booster's photos of one camera lie
    return old or _has(folder, "scene.json") or (new and not is_two_view(folder))


# In the order in which a folder is guessed: the plainest marks last.
LAYOUTS = {
    "booster": Layout(
        "train/balanced/SCENE/camera_00/*.png",
        lambda folder: _has(folder, "camera_00"),
        skip=frozenset({"test", "unbalanced"}),
    ),
    "wildrgbd": Layout(
        "CATEGORY/scenes/SCENE/ with rgb/, depth/, metadata and cam_poses.txt",
        lambda folder: _has(folder, "rgb") and _has(folder, "cam_poses.txt", "metadata", "masks"),
    ),
    "eth3d": Layout(
        "SCENE/dslr_calibration_undistorted/images.txt, or two views: SCENE_1l/im0.png",
        _is_eth3d,
        skip=frozenset({"two_view_testing"}),
    ),
    "middlebury": Layout(
        "SCENE/im0.png with calib.txt, SCENE/view1.png with disp1.png, SCENE/im2.ppm with disp2.pgm, or a scene.json",
        _is_middlebury,
        skip=frozenset({"test", "testF", "testH", "testQ"}),
    ),
    "llff": Layout(
        "SCENE/poses_bounds.npy or SCENE/sparse/0 beside SCENE/images_4 or SCENE/images",
        lambda folder: _has(folder, "poses_bounds.npy", "sparse") and not _called(folder, TANKS_SCENES),
    ),
    "tanks": Layout("SCENE/sparse/0 beside SCENE/images", _is_tanks),
}
