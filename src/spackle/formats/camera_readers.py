"""Read the camera files of other programs: nerfstudio, 3DGS, COLMAP, Record3D and Polycam.

`read_camera_set` finds out which program wrote a file. Spackle's own format is in
`camera_files.py`.
"""

from __future__ import annotations

import codecs
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from PIL import Image
from pydantic import BaseModel, Field, RootModel, ValidationError
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import quat_to_matrix
from spackle.core.image_files import read_image
from spackle.formats.camera_files import (
    MAX_FILE_BYTES,
    MAX_FRAMES,
    Number,
    Row3,
    Row4,
    SidePx,
    checked_camera,
    load_cameras,
)
from spackle.formats.camera_set import CameraSet
from spackle.formats.colmap import (
    DAMAGED,
    MODEL_FOLDERS,
    find_model,
    images_path,
    pose_of_image,
    read_images,
    read_lenses,
)
from spackle.runtime.errors import InputError, as_input_error, short_repr
from spackle.runtime.files import check_file

# From a camera of OpenGL (x right, y up, z back) to one of OpenCV (x right, y down, z forward).
OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))

# How far a rotation times its transpose may be from the identity: published poses are rounded.
ROTATION_TOLERANCE = 1e-2

TRANSFORMS_NAME = "transforms.json"
CAMERAS_NAME = "cameras.json"
# Where nerfstudio notes how it moved and scaled a scene before training.
DATAPARSER_NAME = "dataparser_transforms.json"

# Lenses of nerfstudio that are pinholes, but for a distortion that is left out.
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
DISTORTION_NOTE = "the distortion of its lenses is left out: views are those of pinholes"
PICTURE_SUFFIXES = ("", ".png", ".jpg")  # which a name may leave out
# A file of cameras has one of these keys: "frames" of nerfstudio, and of Spackle's own cameras;
# "camera_path" of nerfstudio's viewer; "poses" of Record3D; "t_00", the first number of Polycam's
# matrix. A file of keyframes has none of them.
CAMERA_KEYS = ("frames", "camera_path", "poses", "t_00")

KNOWN_KINDS = (
    "give Spackle's cameras (K and world_to_camera, docs/inputs.md), transforms.json of "
    "nerfstudio, cameras.json of 3DGS, or a COLMAP folder"
)

Vector16 = Annotated[list[Number], Field(min_length=16, max_length=16)]
Vector9 = Annotated[list[Number], Field(min_length=9, max_length=9)]
Vector7 = Annotated[list[Number], Field(min_length=7, max_length=7)]
Pose = Annotated[list[Row4], Field(min_length=3, max_length=4)]
Model = TypeVar("Model", bound=BaseModel)


class _NerfLens(BaseModel):
    """A lens of nerfstudio or instant-ngp, in a file or in one of its frames."""

    w: Number | None = None
    h: Number | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_angle_x: Number | None = None  # radians, in place of fl_x
    camera_angle_y: Number | None = None
    camera_model: str | None = None
    is_fisheye: bool = False
    k1: Number = 0
    k2: Number = 0
    k3: Number = 0
    k4: Number = 0
    p1: Number = 0
    p2: Number = 0


class _NerfFrame(_NerfLens):
    """A frame of nerfstudio's file."""

    file_path: str = ""
    transform_matrix: Pose  # camera to world, OpenGL's axes at the camera


class _NerfFile(_NerfLens):
    """nerfstudio's transforms.json."""

    frames: Annotated[list[_NerfFrame], Field(min_length=1, max_length=MAX_FRAMES)]
    ply_file_path: str | None = None  # sparse points, in the world of the frames


class _DataparserFile(BaseModel):
    """nerfstudio's dataparser_transforms.json."""

    transform: Pose
    scale: Number


class _NerfPathCamera(BaseModel):
    """A camera of a path from nerfstudio's viewer."""

    camera_to_world: Vector16  # row by row
    fov: Number  # vertical, in degrees


class _NerfPathFile(BaseModel):
    """A path from nerfstudio's viewer."""

    camera_path: Annotated[list[_NerfPathCamera], Field(min_length=1, max_length=MAX_FRAMES)]
    render_width: SidePx
    render_height: SidePx
    camera_type: str = "perspective"
    fps: Number = 24.0


class _InriaCamera(BaseModel):
    """A camera in INRIA's cameras.json."""

    id: int | None = None  # the place in the order of the pictures
    img_name: str = ""
    width: SidePx
    height: SidePx
    position: Row3  # of the camera in the world
    rotation: tuple[Row3, Row3, Row3]  # camera to world, OpenCV's axes at the camera
    fx: Number
    fy: Number


class _InriaFile(RootModel[list[_InriaCamera]]):
    """INRIA's cameras.json."""

    root: Annotated[list[_InriaCamera], Field(min_length=1, max_length=MAX_FRAMES)]


class _Record3DFile(BaseModel):
    """Record3D's metadata.json."""

    w: SidePx
    h: SidePx
    K: Vector9  # column by column
    # x, y, z, w of the rotation camera to world with OpenGL's axes, and the position.
    poses: Annotated[list[Vector7], Field(min_length=1, max_length=MAX_FRAMES)]
    fps: Number = 30.0


class _PolycamFile(BaseModel):
    """A camera of Polycam: camera to world, OpenGL's axes at the camera, and the lens."""

    t_00: Number
    t_01: Number
    t_02: Number
    t_03: Number
    t_10: Number
    t_11: Number
    t_12: Number
    t_13: Number
    t_20: Number
    t_21: Number
    t_22: Number
    t_23: Number
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    width: SidePx
    height: SidePx


def read_camera_set(path: Path) -> CameraSet:
    """Read the cameras of a file or folder of any known program.

    Raises:
        InputError: the cameras are of an unknown kind, impossible, or have lenses that are too far
            from a pinhole.
    """
    file = _file_in_folder(path)
    if file.is_dir():
        return _read_folder(file)
    if file.suffix.lower() != ".json":
        check_file(file, "camera file")
        raise InputError(f"{path}: not a file of cameras: {KNOWN_KINDS}")

    if check_file(file, "camera file") > MAX_FILE_BYTES:
        limit = f"at most {MAX_FILE_BYTES >> 20} MiB"
        raise InputError(f"{file}: too long for a camera file ({limit}): is it the right file?")
    content = _peek(file)
    if isinstance(content, list):
        return _read_inria(file, content)
    if not isinstance(content, dict):
        content = {}  # the reader of Spackle's own format says what is wrong
    frames = content.get("frames")
    first_frame = frames[0] if isinstance(frames, list) and frames else None
    if isinstance(first_frame, dict) and "transform_matrix" in first_frame:
        return _read_nerfstudio(file, content)
    if "camera_path" in content:
        return _read_nerfstudio_path(file, content)
    if "poses" in content and "K" in content:
        return _read_record3d(file, content)
    if "t_00" in content:
        return _read_polycam([file])
    if content and "frames" not in content:
        raise InputError(f"{path}: not a file of cameras: {KNOWN_KINDS}")
    return _read_own(file)


def is_path_file(path: Path) -> bool:
    """Return whether a file is to be read as Spackle's keyframes, not as a set of cameras.

    A file that is neither counts as keyframes, because the message of their reader says what a file
    of a path needs.
    """
    file = _file_in_folder(path)
    if file.is_dir():  # of COLMAP or Polycam
        return False
    # The reader of keyframes refuses other suffixes and files that are too large, and says why.
    if file.suffix.lower() != ".json" or check_file(file, "path file") > MAX_FILE_BYTES:
        return True
    content = _peek(file)
    if isinstance(content, list):  # the cameras of 3DGS
        return False
    has_cameras = isinstance(content, dict) and any(key in content for key in CAMERA_KEYS)
    return not has_cameras


def camera_source_files(path: Path) -> list[Path]:
    """Return the files that `read_camera_set` reads, without pictures, to know if they changed."""
    file = _file_in_folder(path)
    if not file.is_dir():
        sibling = file.parent / DATAPARSER_NAME
        return [file, sibling] if sibling.is_file() else [file]
    model = find_model(file, (".", *MODEL_FOLDERS))
    if model is None:
        return sorted(file.glob("*.json"))
    suffix = images_path(model).suffix
    return [model / f"cameras{suffix}", model / f"images{suffix}"]


def _file_in_folder(path: Path) -> Path:
    """Return the file that holds the cameras of `path`, or a folder whose files hold them together.

    That is `path` itself if it is a file, but the folder of a file of a COLMAP model. For a folder
    it is the file of cameras in it, if there is a single one.
    """
    if path.is_file() and path.stem in ("cameras", "images") and path.suffix in (".bin", ".txt"):
        return path.parent
    for name in (TRANSFORMS_NAME, CAMERAS_NAME):
        if path.is_dir() and (path / name).is_file():
            return path / name
    return path


def _read_folder(folder: Path) -> CameraSet:
    """Read a folder of COLMAP or Polycam."""
    model = find_model(folder, (".", *MODEL_FOLDERS))
    if model is not None:
        return _read_colmap(model)
    files = sorted(folder.glob("*.json"))[: MAX_FRAMES + 1]
    if files:
        return _read_polycam(files)
    raise InputError(f"{folder}: holds no cameras: {KNOWN_KINDS}")


def _peek(path: Path) -> Any:
    """Return the parsed JSON of a file; None if it is no JSON, which pydantic models refuse."""
    text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _validated(model: type[Model], content: Any, path: Path) -> Model:
    """Return the content of a file after a check; InputError if it does not fit the model."""
    with as_input_error(path, "{reason}", ValidationError, RecursionError):
        return model.model_validate(content)


def _read_own(path: Path) -> CameraSet:
    """Read Spackle's own format."""
    cameras = [camera.to(dtype=torch.float64) for camera in load_cameras(path)]
    return CameraSet(
        source=path,
        kind="Spackle",
        cameras=tuple(cameras),
        names=("",) * len(cameras),
        origin=None,
    )


def _read_nerfstudio(path: Path, content: Any) -> CameraSet:
    """Read transforms.json of nerfstudio, instant-ngp or a synthetic scene of NeRF.

    A dataparser_transforms.json beside the file says how nerfstudio moved and scaled the scene
    before it was trained; the cameras are moved and scaled likewise.
    """
    file = _validated(_NerfFile, content, path)
    notes = []
    dataparser = _dataparser_beside(path)
    if dataparser is not None:
        notes.append(f"moved and scaled as {DATAPARSER_NAME} says")

    cameras = []
    for index, frame in enumerate(file.frames):
        where = f"{path}: frame {index}"
        # The file states a lens for all frames; what a frame states itself replaces it.
        lens = file.model_dump(exclude={"frames", "ply_file_path"}, exclude_unset=True)
        lens |= frame.model_dump(
            exclude={"file_path", "transform_matrix"}, exclude_unset=True, exclude_none=True
        )
        K, width, height = _nerf_lens(_NerfLens(**lens), path.parent / frame.file_path, where)

        # [4, 4] from the camera to the world. nerfstudio first moves the scene, then scales it:
        # the scale changes where a camera stands, and not where it looks.
        pose = _four_rows(frame.transform_matrix)
        if dataparser is not None:
            pose = _four_rows(dataparser.transform) @ pose
            pose[:3, 3] *= dataparser.scale

        # These programs' cameras have OpenGL's axes: y up, and looking along -z.
        cameras.append(_camera(K, pose @ OPENGL_TO_OPENCV, width, height, where))

    if any(_has_distortion(lens) for lens in (file, *file.frames)):
        notes.append(DISTORTION_NOTE)
    return CameraSet(
        source=path,
        kind="nerfstudio",
        cameras=tuple(cameras),
        names=tuple(frame.file_path for frame in file.frames),
        origin=OPENGL_TO_OPENCV,  # of a photo without a camera: at the world's origin, along -z
        notes=tuple(notes),
    )


def _dataparser_beside(path: Path) -> _DataparserFile | None:
    """Return how nerfstudio moved and scaled the scene of a transforms.json; None if it did not."""
    dataparser_path = path.parent / DATAPARSER_NAME
    if not dataparser_path.is_file():
        return None
    return _validated(_DataparserFile, _peek(dataparser_path), dataparser_path)


def nerfstudio_points(path: Path) -> tuple[Path, Tensor] | None:
    """Return the file of sparse points that nerfstudio's transforms.json names.

    Args:
        path: a file that `read_camera_set` has read.

    Returns:
        The file, and the matrix [4, 4] from its world to that of the cameras; None if the cameras'
        file names no points, or they are not there.
    """
    content = _peek(path)
    name = content.get("ply_file_path") if isinstance(content, dict) else None
    if not isinstance(name, str) or not (path.parent / name).is_file():
        return None
    to_world = torch.eye(4, dtype=torch.float64)
    dataparser = _dataparser_beside(path)
    if dataparser is not None:
        to_world[:3] = dataparser.scale * _four_rows(dataparser.transform)[:3]
    return path.parent / name, to_world


def _has_distortion(lens: _NerfLens) -> bool:
    """Return whether a lens is not a pure pinhole."""
    return any((lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2))


def _nerf_lens(lens: _NerfLens, picture: Path, where: str) -> tuple[Tensor, int, int]:
    """Return the intrinsics K [3, 3], width and height of a lens.

    Args:
        lens: the lens.
        picture: the frame's picture, whose size is used if the lens has none.
        where: names the frame in messages.

    Raises:
        InputError: the lens is no pinhole, or has no size or focal length.
    """
    model = (lens.camera_model or "OPENCV").upper()
    if lens.is_fisheye or model not in PINHOLE_MODELS:
        kind = "a fisheye" if lens.is_fisheye else short_repr(lens.camera_model)
        problem = f"the lens is {kind}, not a pinhole"
        raise InputError(f"{where}: {problem}: undistort the pictures first")

    size = (lens.w, lens.h)
    if lens.w is None or lens.h is None:
        size = _picture_size(picture, where)
    width, height = (_whole(side, where) for side in size)
    fx = lens.fl_x
    if fx is None and lens.camera_angle_x is not None:
        fx = _focal_from_angle(width, lens.camera_angle_x)
    fy = lens.fl_y
    if fy is None and lens.camera_angle_y is not None:
        fy = _focal_from_angle(height, lens.camera_angle_y)
    # Pixels are square unless something else is said.
    fx = fy if fx is None else fx
    fy = fx if fy is None else fy
    if fx is None or fy is None:
        raise InputError(f"{where}: no focal length: give fl_x or camera_angle_x")
    cx = width / 2 if lens.cx is None else lens.cx
    cy = height / 2 if lens.cy is None else lens.cy
    return _intrinsics(fx, fy, cx, cy), width, height


def _focal_from_angle(side_px: int, angle_rad: float) -> float:
    """Return the focal length in pixels with which a side spans an angle; 0 for no such angle."""
    tangent = math.tan(angle_rad / 2)
    return side_px / 2 / tangent if tangent > 0 else 0


def _whole(side: float | None, where: str) -> int:
    """Return a side in pixels, which some programs write as 1920.0; InputError for a fraction."""
    if side is None or not float(side).is_integer():
        raise InputError(f"{where}: w and h must be whole numbers")
    return int(side)


def _picture_size(path: Path, where: str) -> tuple[int, int]:
    """Return width and height of a picture; InputError if there is none."""
    advice = "give w and h, or put the picture there"
    # A name may be too long for a file, or hold a zero.
    with as_input_error(where, f"no size ({{reason}}): {advice}", OSError, ValueError):
        for suffix in PICTURE_SUFFIXES:
            file = path.with_name(f"{path.name}{suffix}") if path.name else path
            if file.is_file():
                return read_image(file, _stored_size)
    raise InputError(f"{where}: no size: {advice}")


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Return width and height of an opened picture, as it is stored."""
    return image.size


def _read_nerfstudio_path(path: Path, content: Any) -> CameraSet:
    """Read a path from nerfstudio's viewer."""
    file = _validated(_NerfPathFile, content, path)
    if file.camera_type != "perspective":
        kind = short_repr(file.camera_type)
        raise InputError(f"{path}: a path of the kind {kind}: give one of the kind 'perspective'")
    width, height = file.render_width, file.render_height
    cameras = []
    for index, entry in enumerate(file.camera_path):
        focal_px = _focal_from_angle(height, math.radians(entry.fov))
        K = _intrinsics(focal_px, focal_px, width / 2, height / 2)
        pose = torch.tensor(entry.camera_to_world, dtype=torch.float64).reshape(4, 4)
        where = f"{path}: camera {index}"
        cameras.append(_camera(K, pose @ OPENGL_TO_OPENCV, width, height, where))
    return CameraSet(
        source=path,
        kind="nerfstudio",
        cameras=tuple(cameras),
        names=("",) * len(cameras),
        origin=OPENGL_TO_OPENCV,
        seconds_per_camera=_seconds_per_frame(file.fps, path),
    )


def _seconds_per_frame(fps: float, path: Path) -> float:
    """Return 1 / fps; InputError for an impossible number of frames a second."""
    if not 0 < fps <= MAX_FRAMES:
        raise InputError(f"{path}: fps must be positive, not {fps:g}")
    return 1 / fps


def _read_inria(path: Path, content: Any) -> CameraSet:
    """Read cameras.json, which INRIA's 3DGS and its followers write beside a scene."""
    is_inria = bool(content) and isinstance(content[0], dict) and "rotation" in content[0]
    if not is_inria:
        raise InputError(f"{path}: not a file of cameras: {KNOWN_KINDS}")
    file = _validated(_InriaFile, content, path)
    # A program may have shuffled the list; the ids tell the order of the pictures, if each camera
    # has one of its own.
    ids = [entry.id for entry in file.root if entry.id is not None]
    entries = file.root
    if len(set(ids)) == len(entries):
        numbered = sorted(zip(ids, entries, strict=True), key=lambda pair: pair[0])
        entries = [entry for _, entry in numbered]
    cameras = []
    for index, entry in enumerate(entries):
        K = _intrinsics(entry.fx, entry.fy, entry.width / 2, entry.height / 2)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(entry.rotation, dtype=torch.float64)
        pose[:3, 3] = torch.tensor(entry.position, dtype=torch.float64)
        where = f"{path}: camera {index}"
        cameras.append(_camera(K, pose, entry.width, entry.height, where))
    return CameraSet(
        source=path,
        kind="3DGS",
        cameras=tuple(cameras),
        names=tuple(entry.img_name for entry in entries),
        origin=torch.eye(4, dtype=torch.float64),
    )


def _read_colmap(folder: Path) -> CameraSet:
    """Read the cameras of a COLMAP model, sorted by the names of their pictures."""
    lenses = read_lenses(folder)
    path = images_path(folder)
    posed = []
    has_distortion = False
    with as_input_error(path, DAMAGED):
        for record in read_images(folder):
            lens = lenses[record.camera_key]
            has_distortion |= any(lens.distortion)
            world_to_camera = pose_of_image(record, str(path))
            pose = torch.linalg.inv(world_to_camera)
            where = f"{path}: the pose of {record.name}"
            camera = _camera(lens.camera.K, pose, lens.camera.width, lens.camera.height, where)
            posed.append((record.name, camera))
            if len(posed) > MAX_FRAMES:
                raise InputError(f"{path}: more than {MAX_FRAMES} pictures: give fewer")
    if not posed:
        raise InputError(f"{path}: holds no pictures: give a model with some")
    posed.sort(key=lambda item: item[0])
    return CameraSet(
        source=folder,
        kind="COLMAP",
        cameras=tuple(camera for _, camera in posed),
        names=tuple(name for name, _ in posed),
        origin=torch.eye(4, dtype=torch.float64),
        notes=(DISTORTION_NOTE,) if has_distortion else (),
    )


def _read_record3d(path: Path, content: Any) -> CameraSet:
    """Read metadata.json of Record3D, an app for iPhones."""
    file = _validated(_Record3DFile, content, path)
    K = torch.tensor(file.K, dtype=torch.float64).reshape(3, 3).T
    cameras = []
    for index, (x, y, z, w, *position) in enumerate(file.poses):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = quat_to_matrix(torch.tensor([w, x, y, z], dtype=torch.float64))
        pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
        where = f"{path}: pose {index}"
        cameras.append(_camera(K, pose @ OPENGL_TO_OPENCV, file.w, file.h, where))
    return CameraSet(
        source=path,
        kind="Record3D",
        cameras=tuple(cameras),
        # Its pictures are numbered.
        names=tuple(f"{index}.jpg" for index in range(len(cameras))),
        origin=OPENGL_TO_OPENCV,
        is_metric=True,
        seconds_per_camera=_seconds_per_frame(file.fps, path),
    )


def _read_polycam(files: Sequence[Path]) -> CameraSet:
    """Read the cameras of Polycam, one file for each picture."""
    cameras = []
    for path in files:
        size = check_file(path, "camera file")
        content = _peek(path) if size <= MAX_FILE_BYTES else None
        if not isinstance(content, dict) or "t_00" not in content:
            raise InputError(f"{path}: not a file of cameras: {KNOWN_KINDS}")
        entry = _validated(_PolycamFile, content, path)
        rows = [[getattr(entry, f"t_{row}{column}") for column in range(4)] for row in range(3)]
        K = _intrinsics(entry.fx, entry.fy, entry.cx, entry.cy)
        pose = _four_rows(rows) @ OPENGL_TO_OPENCV
        cameras.append(_camera(K, pose, entry.width, entry.height, str(path)))
    return CameraSet(
        source=files[0].parent if len(files) > 1 else files[0],
        kind="Polycam",
        cameras=tuple(cameras),
        names=tuple(f"{path.stem}.jpg" for path in files),
        origin=OPENGL_TO_OPENCV,
        is_metric=True,
    )


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """Return K [3, 3] in float64, from focal lengths and principal point in pixels."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _four_rows(rows: Iterable[Sequence[float]]) -> Tensor:
    """Return a pose [4, 4] in float64 from three or four rows; the last one is 0 0 0 1."""
    three_rows = torch.tensor(list(rows), dtype=torch.float64)[:3]
    return torch.cat([three_rows, three_rows.new_tensor([[0, 0, 0, 1]])])


def _camera(K: Tensor, camera_to_world: Tensor, width: int, height: int, where: str) -> Camera:
    """Return a float64 camera from its pose camera to world, with OpenCV's axes at the camera.

    Args:
        K: [3, 3] intrinsics in pixels.
        camera_to_world: [4, 4].
        width, height: of the picture in pixels.
        where: names the camera in messages.

    Raises:
        InputError: the camera is impossible.
    """
    # The pose is checked before it is inverted, so that messages show the numbers of the file.
    camera = checked_camera(
        K,
        camera_to_world,
        width,
        height,
        where,
        dtype=torch.float64,
        tolerance=ROTATION_TOLERANCE,
        pose_name="the pose",
    )
    # Without rounding errors in the rotation, the transpose is the inverse; Newton's step towards
    # the nearest rotation removes them.
    rotation = camera_to_world[:3, :3]
    rotation = 1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation.T
    world_to_camera[:3, 3] = -rotation.T @ camera_to_world[:3, 3]
    return Camera(camera.K, world_to_camera, width, height)
