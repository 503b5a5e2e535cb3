"""The depth map that a portrait photo brings along, upright as the photo: Apple's and Android's, in HEIC and JPEG."""

from __future__ import annotations

import dataclasses
import mmap
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from spackle.bases.depth_map import ASPECT_TOLERANCE, DepthMap, StrPath
from spackle.bases.photo_depth.coded import BY_ORIENTATION, UPRIGHT, BrokenDepth, CodedDepth, Turn
from spackle.bases.photo_depth.layouts import find_android, find_apple, find_in_heif
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.image import DEFAULT_FOCAL_MM, check_file, film_to_pixels, focal_from_exif, read_image

_EXIF_IFD, _ORIENTATION = 0x8769, 0x0112
PLAUSIBLE_M = (0.3, 30.0)  # a scene's middle, where the file does not say its unit
USUAL_M = 3.0


def load_photo_depth(path: StrPath) -> DepthMap | None:
    """The depth map inside a photo, upright as the photo itself is; None where it has none.

    Read are, in HEIC, an auxiliary depth image with Apple's XMP or HEVC's depth information; in JPEG,
    Apple's auxiliary pictures, Android's Dynamic Depth and the older GDepth. `DepthMap.note` says what
    it was and how far its metres are to be trusted. The picture itself is not decoded.

    Raises:
        InputError: a missing file, or a photo whose depth map is broken or of another crop.
    """
    size = check_file(path, "photo")
    try:
        coded = _find(path) if size >= 12 else None
        return None if coded is None else _depth_map(coded, path)
    except BrokenDepth as error:
        raise InputError(
            f"{path}: the depth map in the photo {error}: give another one with --depth FILE, or use --base lite"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def _find(path: StrPath) -> CodedDepth | None:
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:3] == b"\xff\xd8\xff":
            return find_apple(data) or find_android(data)
        return find_in_heif(data, path) if data[4:8] == b"ftyp" else None


@dataclasses.dataclass(frozen=True)
class _Frame:
    """The photo around the map, as its header has it."""

    width: int  # upright
    height: int
    turn: Turn  # from the stored pixels
    focal_px: float


def _depth_map(coded: CodedDepth, path: StrPath) -> DepthMap:
    frame = read_image(path, _frame)
    turn = coded.turn.then(frame.turn)
    stored, quantum = coded.scale.decode(coded.codes, coded.full)
    depth = turn.grid(torch.from_numpy(stored))
    height, width = depth.shape
    if abs(width * frame.height / (height * frame.width) - 1) > ASPECT_TOLERANCE:
        raise BrokenDepth(f"has {width}×{height} pixels but the photo {frame.width}×{frame.height}, another crop")
    before = coded.codes.shape[:: 1 if coded.turned.transpose else -1]
    K = None if coded.lens is None else coded.lens.matrix(*before)
    K = None if K is None else coded.turned.then(turn).matrix(K, *before)
    if coded.along_ray:
        depth, quantum = depth / _lengthening(K, frame, width, height), None
    note = f"portrait depth of the photo ({coded.source}"
    if not coded.unit_known and (factor := _usual_factor(depth)) != 1:
        depth, note = depth * factor, f"{note}, scaled to a median of {USUAL_M:g} m"
        quantum = quantum and quantum * (factor if coded.scale.quantity == "depth" else 1 / factor)
    metres = depth.float()
    valid = _known(metres)
    if not valid.any():
        raise BrokenDepth("has no pixel with a depth")
    return DepthMap(metres.where(valid, 0.0), valid, K, quantum, coded.scale.quantity, Path(path), f"{note})")


def _known(depth: Tensor) -> Tensor:
    """A depth without a finite inverse is none."""
    return torch.isfinite(depth) & (depth > 0) & torch.isfinite(1 / depth)


def _frame(image: Image.Image) -> _Frame:
    try:
        exif = image.getexif()
        orientation, tags = exif.get(_ORIENTATION, 1), {**exif, **exif.get_ifd(_EXIF_IFD)}
        turn = BY_ORIENTATION.get(orientation, UPRIGHT)
    except Exception:  # unreadable EXIF says nothing about the orientation
        turn, tags = UPRIGHT, {}
    width, height = image.size[::-1] if turn.transpose else image.size
    focal = focal_from_exif(tags, width, height) or film_to_pixels(DEFAULT_FOCAL_MM, width, height)
    return _Frame(width, height, turn, focal)


def _lengthening(K: Tensor | None, frame: _Frame, width: int, height: int) -> Tensor:
    """[H, W] how much longer than its z the way from the eye to a point is."""
    own = Camera.from_focal(frame.focal_px, frame.width, frame.height).resized(width, height)
    camera = own if K is None else Camera(K, torch.eye(4), width, height)
    rays = camera.unproject(camera.pixel_centers(), torch.ones(height, width))
    return rays.square().sum(-1).sqrt()


def _usual_factor(depth: Tensor) -> float:
    """What brings a map without a unit to the size of a usual scene; 1 where it has that size."""
    known = depth[_known(depth)]
    middle = float(known.median()) if len(known) else USUAL_M
    return 1.0 if PLAUSIBLE_M[0] <= middle <= PLAUSIBLE_M[1] else USUAL_M / middle
