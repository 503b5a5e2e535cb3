"""An uploaded photo: what is refused before a byte is read, how it is read, and whether it is a photo at all."""

from __future__ import annotations

import dataclasses
import re
from email.message import Message
from http import HTTPStatus
from io import BufferedIOBase
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qs

from PIL import Image

from spackle.errors import InputError
from spackle.image import PHOTO_SUFFIXES, read_image

PIECE = 1 << 18  # bytes
MAX_NAME = 80  # characters that are shown
# What Pillow may find in a file, whatever its name says: it knows formats that are read by other programs, too.
FORMATS = frozenset({"JPEG", "MPO", "PNG", "WEBP", "HEIF", "TIFF"})
KINDS = ", ".join(suffix.removeprefix(".") for suffix in PHOTO_SUFFIXES)


class RefusedError(Exception):
    """An upload that is not taken: the answer's status, and one line."""

    def __init__(self, status: HTTPStatus, line: str) -> None:
        super().__init__(line)
        self.status, self.line = status, line


@dataclasses.dataclass(frozen=True)
class Declared:
    """What a request says of its photo."""

    name: str  # for people; no file is ever called so
    suffix: str  # one of PHOTO_SUFFIXES
    length: int


def declared(headers: Message, query: str, max_bytes: int) -> Declared:
    """Read the request's promises.

    Raises:
        RefusedError: no length, too long, or a kind of file that is not taken.
    """
    lengths = headers.get_all("Content-Length", [])
    if not lengths or "Transfer-Encoding" in headers:
        raise RefusedError(HTTPStatus.LENGTH_REQUIRED, "send the photo with a Content-Length, not in chunks")
    if len(lengths) > 1 or not re.fullmatch(r"[0-9]{1,18}", lengths[0].strip()):
        raise RefusedError(HTTPStatus.BAD_REQUEST, "the Content-Length makes no sense")
    name = shown_name(query)
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in PHOTO_SUFFIXES:
        raise RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"{name}: not a photo: give {KINDS}")
    length = int(lengths[0])
    if length > max_bytes:
        megabytes = f"{max_bytes / 1e6:g} MB"
        raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"{name}: more than {megabytes}: shrink it first")
    if length == 0:
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"{name}: the file is empty")
    return Declared(name, suffix, length)


def shown_name(query: str) -> str:
    """The last part of `name=…` in a form that no terminal, page or log can take for anything but a name."""
    try:
        values = parse_qs(query, errors="replace", max_num_fields=4).get("name", [])
    except ValueError:
        values = []
    last = re.split(r"[/\\]", values[0])[-1] if values else ""
    name = "".join(character for character in last if character.isprintable()).strip()
    return name if len(name) <= MAX_NAME else f"{name[: MAX_NAME // 2]}…{name[-MAX_NAME // 2 :]}"


def receive(stream: BufferedIOBase, path: Path, promise: Declared) -> None:
    """Write the promised bytes to a file.

    Raises:
        RefusedError: fewer came, or the disk is full.
        TimeoutError: as the stream does.
    """
    left = promise.length
    try:
        with path.open("xb") as file:
            while left:
                piece = stream.read(min(PIECE, left))
                if not piece:
                    raise RefusedError(HTTPStatus.BAD_REQUEST, f"{promise.name}: only a part of it has come")
                left -= len(piece)
                file.write(piece)
    except (TimeoutError, ConnectionError):
        raise
    except OSError as error:
        line = f"{promise.name}: cannot be kept here: {error.strerror}"
        raise RefusedError(HTTPStatus.INSUFFICIENT_STORAGE, line) from error


def check_photo(path: Path, name: str) -> None:
    """Decode all of a file's pixels, within the limits of `spackle.image`.

    Raises:
        RefusedError: it is no photo of a kind that is taken.
    """

    def decode(image: Image.Image) -> None:
        if image.format not in FORMATS:
            raise InputError(f"{path}: a {image.format} picture: give {KINDS}")
        image.load()

    try:
        read_image(path, decode)
    except InputError as error:
        line = str(error).replace(str(path), name)
        raise RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, line) from error
