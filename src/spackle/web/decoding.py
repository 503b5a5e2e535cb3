"""Decoding of what clients send, in a process that can be ended: some files take for ever."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from PIL import Image

from spackle.core.color import to_uint8
from spackle.core.image_files import OpenPicture, read_picture
from spackle.core.photo import check_photo_size, refuse_if_not_flat
from spackle.core.srgb_pictures import picture_to_srgb
from spackle.formats.camera_files import camera_from_json
from spackle.runtime.errors import InputError
from spackle.runtime.task_process import SendEvent
from spackle.web.edits import sent_mask

PREVIEW_SIDE_PX = 1280  # pixels of the preview's long side


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoCheck:
    """Arguments of `check_photo`."""

    path: Path
    name: str
    preview: Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class MaskCheck:
    """A mask's file, and the camera in whose view it was drawn, as JSON."""

    path: Path
    camera: dict[str, Any]


DecodingTask = PhotoCheck | MaskCheck


def decode_upload(task: DecodingTask, send_event: SendEvent) -> None:
    """Decode an uploaded file; the function of a worker process.

    Args:
        task: the file.
        send_event: is not used.

    Raises:
        InputError: the file is unusable. The message has no path of this server.
    """
    if isinstance(task, PhotoCheck):
        check_photo(task.path, task.name, task.preview)
    else:
        sent_mask(task.path, camera_from_json(task.camera, "camera"))


def check_photo(path: Path, name: str, preview: Path) -> None:
    """Decode a photo, and write a small JPEG of it, which the page shows until the scene is ready.

    Args:
        path: the photo.
        name: what messages call it.
        preview: the file for the small JPEG.

    Raises:
        InputError: the file is no photo of an accepted format, or too small or too large.
    """

    def write_preview(picture: OpenPicture) -> None:
        """Check the photo at `path`, which is open, and write the small JPEG, upright and in sRGB.

        `path` and `preview` are arguments of `check_photo`.
        """
        refuse_if_not_flat(picture, path)
        check_photo_size(picture.image.width, picture.image.height, path)
        # Decodes all pixels, and so finds damage.
        small = picture_to_srgb(picture, path, max_side=PREVIEW_SIDE_PX)
        Image.fromarray(to_uint8(small.rgb).numpy()).save(preview, quality=85)

    try:
        read_picture(path, write_preview)
    except InputError as error:
        raise InputError(str(error).replace(str(path), name)) from error
