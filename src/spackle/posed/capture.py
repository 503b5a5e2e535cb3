"""Read a folder of photos with known cameras: COLMAP's, nerfstudio's, Record3D's or Polycam's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import torch

from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.image_formats import list_photos
from spackle.core.photo import Photo, load_photo
from spackle.depth.readers import DEPTH_SUFFIXES
from spackle.formats.camera_readers import camera_source_files, read_camera_set
from spackle.formats.camera_set import CameraSet
from spackle.formats.sparse_points import SparsePoints, read_sparse_points
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_file
from spackle.video.frames import SAME_ASPECT_TOLERANCE

MIN_PHOTOS = 2
# A phone's capture has hundreds of frames, most of which show the same; each photo becomes some
# 100,000 Gaussians, and is compared with every other one.
MAX_PHOTOS = 100
# Where photos lie within a folder or beside its model, in the order in which they are looked for;
# "" is the folder itself.
PHOTO_FOLDERS = ("", "images", "images_2", "images_4", "images_8", "rgb", "rgbd", "rgb_images")
# Where Polycam puts its cameras; those that it has corrected come first.
POLYCAM_CAMERAS = ("keyframes/corrected_cameras", "keyframes/cameras", "cameras")
RECORD3D_NAMES = ("metadata.json", "metadata")
# Folders of depth maps in metres or millimetres, named like the photos.
DEPTH_FOLDERS = ("depth", "depths", "rgbd")
POLYCAM_PHOTOS = ("keyframes/corrected_images", "keyframes/images", "corrected_images")


@dataclasses.dataclass(frozen=True)
class PosedFile:
    """A photo's file, its camera, and its depth map if one lies beside it."""

    path: Path
    name: str  # in the file of cameras
    camera: Camera  # float64, in the world of the file, at the size that the file states
    depth: Path | None = None

    def load(self) -> Photo:
        """The photo with the focal length of its camera.

        Raises:
            InputError: the photo cannot be read, or has other proportions than its camera.
        """
        photo = load_photo(self.path, keep_frame=True)
        across = photo.width / self.camera.width
        down = photo.height / self.camera.height
        if abs(across / down - 1) > SAME_ASPECT_TOLERANCE:
            stated = f"{self.camera.width}×{self.camera.height}"
            raise InputError(
                f"{self.path}: {photo.width}×{photo.height}, but its camera is of a picture of "
                f"{stated}: give the photos from which the cameras were made, not turned or cropped"
            )
        focal_px = self.camera.focal[0] * across
        return dataclasses.replace(photo, focal_px=focal_px, focal_source=FocalSource.CAMERAS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capture:
    """Photos with known cameras in one world."""

    folder: Path
    cameras_file: Path  # the file or folder of the cameras
    kind: str  # who wrote the cameras, such as "COLMAP"
    photos: tuple[PosedFile, ...]  # in the order of the file of cameras
    points: SparsePoints | None  # None: the cameras came without points
    is_metric: bool  # whether the world's unit is known to be the metre
    notes: tuple[str, ...]  # lines for the user

    @property
    def source_files(self) -> list[Path]:
        """All files that decide the result: cameras, points, photos and depth maps."""
        files = camera_source_files(self.cameras_file)
        if self.points is not None:
            files.append(self.points.source)
        for photo in self.photos:
            files.append(photo.path)
            if photo.depth is not None:
                files.append(photo.depth)
        return files


def read_capture(folder: Path) -> Capture:
    """Read the cameras, points and names of the photos of a folder.

    Cameras without a photo, and photos without a camera, are left out with a note.

    Raises:
        InputError: there are no cameras, fewer than two photos with a camera, or a damaged file.
    """
    if not folder.is_dir():
        if folder.exists():
            raise InputError(f"{folder}: not a folder: give the folder of photos and cameras")
        raise InputError(f"{folder}: no such folder: check the name")
    cameras_at = _where_cameras_are(folder)
    cameras = read_camera_set(cameras_at)
    # Cameras without an origin stand around a single photo, and have no world of their own.
    if cameras.origin is None or not any(cameras.names):
        raise InputError(
            f"{cameras.source}: its cameras name no photos: give a COLMAP folder, "
            "transforms.json of nerfstudio, or a capture of Record3D or Polycam"
        )

    files = _photos_in(folder)
    photos: list[PosedFile] = []
    missing: list[str] = []
    for name, camera in zip(cameras.names, cameras.cameras, strict=True):
        path = _photo_of(name, files)
        if path is None:
            missing.append(name)
        else:
            photos.append(PosedFile(path, name, camera, _depth_beside(folder, path)))

    # A model's folder is called "0"; with the folders above it, the name says something.
    source_name = cameras.source.relative_to(folder).as_posix()
    if cameras.source == folder:
        source_name = folder.name
    notes = [f"{source_name}: {note}" for note in cameras.notes]
    if missing:
        notes.append(f"{source_name}: {_named(missing)} without a photo: left out")
    used = {photo.path for photo in photos}
    unused = [file.name for file in files if file not in used]
    if unused:
        notes.append(f"{folder.name}: {_named(unused)} without a camera: left out")
    if len(photos) < MIN_PHOTOS:
        found = "one photo" if photos else "no photo"
        raise InputError(
            f"{folder}: {found} with a camera in {source_name}: several are needed; "
            "one photo alone needs no cameras: `spackle predict PHOTO`"
        )
    if len(photos) > MAX_PHOTOS:
        raise InputError(
            f"{folder}: {len(photos)} photos with cameras, of which each becomes Gaussians: "
            f"delete all but {MAX_PHOTOS} that show the scene from places far apart"
        )
    _refuse_doubles(photos, cameras.source)
    return Capture(
        folder=folder,
        cameras_file=cameras_at,
        kind=cameras.kind,
        photos=tuple(photos),
        points=_points_of(cameras),
        is_metric=cameras.is_metric,
        notes=tuple(notes),
    )


def _points_of(cameras: CameraSet) -> SparsePoints | None:
    """The points beside cameras; None if there are none."""
    points = read_sparse_points(cameras)
    return points if points is not None and len(points.xyz) else None


def _where_cameras_are(folder: Path) -> Path:
    """The file or folder of a folder's cameras, as `read_camera_set` takes it.

    Record3D's and Polycam's are looked for here; `read_camera_set` finds all others in the folder.
    """
    for name in RECORD3D_NAMES:
        if (folder / name).is_file():
            return folder / name
    for name in POLYCAM_CAMERAS:
        if any((folder / name).glob("*.json")):
            return folder / name
    return folder


def _photos_in(folder: Path) -> list[Path]:
    """All photos of the folder, in the places where programs put them; depth maps are none."""
    files: list[Path] = []
    for name in (*PHOTO_FOLDERS, *POLYCAM_PHOTOS):
        place = folder / name
        if place.is_dir():
            # COLMAP's pictures may lie in subfolders of images, one for each camera, so that these
            # are searched, too (`below`).
            files += list_photos(place, below=name == "images")
        # The other folders may hold the same photos at smaller sizes.
        if files:
            return files
    return files


def _photo_of(name: str, files: Sequence[Path]) -> Path | None:
    """The photo that a file of cameras calls `name`; suffix and folders may differ."""
    wanted = PurePosixPath(name.replace("\\", "/"))
    # Of photos of the same name, that in a folder of the same name is meant.
    with_name = [file for file in files if file.name == wanted.name]
    candidates = with_name or [file for file in files if file.stem in (wanted.stem, wanted.name)]
    if len(candidates) <= 1:
        return candidates[0] if candidates else None
    in_folder = [file for file in candidates if file.parent.name == wanted.parent.name]
    return in_folder[0] if len(in_folder) == 1 else None


def _depth_beside(folder: Path, photo: Path) -> Path | None:
    """The depth map of a photo: in a folder of depth maps, with the photo's name."""
    places = [folder / name for name in DEPTH_FOLDERS]
    places += [photo.parent.parent / name for name in DEPTH_FOLDERS]
    for place in places:
        for suffix in DEPTH_SUFFIXES:
            candidate = place / f"{photo.stem}{suffix}"
            if candidate.is_file() and candidate != photo:
                check_file(candidate, "depth map")
                return candidate
    return None


def _named(names: Sequence[str]) -> str:
    """A few names in words: "a.jpg", or "a.jpg and 4 others"."""
    if len(names) == 1:
        return names[0]
    others = "1 other" if len(names) == 2 else f"{len(names) - 1} others"
    return f"{names[0]} and {others}"


def _refuse_doubles(photos: Sequence[PosedFile], source: Path) -> None:
    """Raise an InputError if two cameras took the same photo, or all stand at the same place."""
    names: dict[Path, str] = {}
    for photo in photos:
        if photo.path in names:
            problem = f"{names[photo.path]} and {photo.name} are both the photo {photo.path.name}"
            raise InputError(f"{source}: {problem}: give each photo one camera")
        names[photo.path] = photo.name
    positions = torch.stack([photo.camera.position for photo in photos])
    if bool((positions == positions[0]).all()):
        raise InputError(
            f"{source}: all cameras stand at one place: photos that were only turned show no depth"
        )
