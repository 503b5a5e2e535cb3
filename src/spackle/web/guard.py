"""Security of the viewer's server: who may ask, how much they may take, and which uploads are photos.

A page of a stranger can make a browser send requests to this machine, and by DNS rebinding even under the stranger's
own name. Such a request gives itself away by its Host, its Origin or its Sec-Fetch-Site.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import os
import re
import socket
import time
from collections.abc import Collection, Mapping
from email.message import Message
from http import HTTPStatus
from io import BufferedIOBase
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qs

from PIL import Image

from spackle.errors import InputError
from spackle.image import PHOTO_SUFFIXES, read_image

DEPTH_SUFFIXES = (".npy", ".npz", ".png", ".pfm")  # of a photo, as `spackle predict --depth` takes them


@dataclasses.dataclass(frozen=True)
class Limits:
    """Times are in seconds. The server is for a few people: what is refused is far above what a page asks for."""

    pause: float = 10  # between two pieces of a request, and between two requests of a connection
    upload: float = 300  # all of an upload
    send: float = 20  # for a piece of an answer: a client that never reads must not keep a thread
    heartbeat: float = 10  # of a silent event stream; it is how a listener that has gone shows
    stop: float = 0.5  # for work to end by itself once the server is stopped
    connections: int = 64  # at a time, a thread each
    upload_bytes: int = 100_000_000
    kept_scenes: int = 2  # what is shown, and what a page may still be loading
    kept_jobs: int = 4


DEFAULT = Limits()

HOST = re.compile(r"(\[[0-9a-f:.%]+\]|[0-9a-z._-]+)(?::\d{1,5})?", re.IGNORECASE)
OWN_SITES = ("same-origin", "none")  # none: typed by a person, or a bookmark
PIECE = 1 << 18  # bytes
MAX_NAME = 80  # characters that are shown
# What Pillow may find in a file, whatever its name says: it knows formats that are read by other programs, too.
FORMATS = frozenset({"JPEG", "MPO", "PNG", "WEBP", "HEIF", "TIFF"})
KINDS = ", ".join(suffix.removeprefix(".") for suffix in PHOTO_SUFFIXES)

# The page has its scripts and styles from us alone, sends nothing elsewhere and stands in no other page's frame.
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; media-src blob:; worker-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Cache-Control": "no-store",  # a photo is private; and the next viewer has other scenes under the same paths
    "Content-Security-Policy": CONTENT_POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a numeric address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def own_names(host: str, address: str) -> frozenset[str]:
    """Host names, besides numeric addresses, under which a server at `host` (numeric: `address`) may be asked."""
    names = {"localhost"}
    if not is_loopback(address):
        machine = socket.gethostname().lower()
        names |= {machine, machine.partition(".")[0], f"{machine.partition('.')[0]}.local", host.lower()}
    return frozenset(names)


def refusal(headers: Message, names: Collection[str], *, local: bool, sends: bool = False) -> str | None:
    """Why a request is not for us, or None.

    Args:
        headers: of the request.
        sends: it is a POST, which every browser gives an Origin.
        names: see `own_names`. Numeric addresses need not be among them, for they cannot be rebound; the port may be
            any, for `ssh -L` gives another.
        local: whether the server is for this machine alone; then numeric addresses of others are refused too.
    """
    hosts = headers.get_all("Host", [])
    match = HOST.fullmatch(hosts[0].strip()) if len(hosts) == 1 else None
    if match is None or not _is_own(match[1].lower(), names, local):
        return "this server does not go by that Host name"
    ours = {f"{scheme}://{hosts[0].strip().lower()}" for scheme in ("http", "https")}  # https: by a tunnel
    origins = {origin.strip().lower() for origin in headers.get_all("Origin", [])}
    if not origins <= ours or (sends and not origins):
        return "asked by a page of another Origin"
    if any(site.strip().lower() not in OWN_SITES for site in headers.get_all("Sec-Fetch-Site", [])):
        return "asked by a page of another site"
    return None


def _is_own(name: str, names: Collection[str], local: bool) -> bool:
    try:
        address = ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return name.rstrip(".") in names
    return address.is_loopback or not local


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
    choices: Mapping[str, str] = dataclasses.field(default_factory=dict)  # base, disparity
    depth: tuple[str, int] | None = None  # suffix and bytes of a depth map that follows the photo


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
        line = f"{name}: more than {max_bytes / 1e6:g} MB: shrink it first"
        raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, line)
    if length == 0:
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"{name}: the file is empty")
    fields = _fields(query)
    choices = {key: fields[key][:MAX_NAME] for key in ("base", "disparity") if fields.get(key)}
    return Declared(name, suffix, length, choices, _declared_depth(fields.get("depth", ""), length))


def _declared_depth(text: str, length: int) -> tuple[str, int] | None:
    """`.png:1234`: kind and bytes of what follows the photo; RefusedError for anything else."""
    if not text:
        return None
    match = re.fullmatch(r"(\.[a-z]{3}):([0-9]{1,18})", text)
    if not match or match[1] not in DEPTH_SUFFIXES or not 0 < int(match[2]) < length:
        kinds = ", ".join(DEPTH_SUFFIXES)
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"the depth map makes no sense: give a file of {kinds}")
    return match[1], int(match[2])


def _fields(query: str) -> dict[str, str]:
    """The first value of each field of a query; none where it makes no sense."""
    try:
        return {key: values[0] for key, values in parse_qs(query, errors="replace", max_num_fields=6).items()}
    except ValueError:
        return {}


def shown_name(query: str) -> str:
    """The last part of `name=…` in a form that no terminal, page or log can take for anything but a name."""
    last = re.split(r"[/\\]", _fields(query).get("name", ""))[-1]
    name = "".join(character for character in last if character.isprintable()).strip()
    return name if len(name) <= MAX_NAME else f"{name[: MAX_NAME // 2]}…{name[-MAX_NAME // 2 :]}"


def split_depth(path: Path, promise: Declared) -> Path | None:
    """Cut the depth map off a received photo, into a file beside it."""
    if promise.depth is None:
        return None
    suffix, length = promise.depth
    depth = path.with_name(f"depth{suffix}")
    with path.open("r+b") as file:
        file.seek(-length, os.SEEK_END)
        depth.write_bytes(file.read())
        file.truncate(promise.length - length)
    return depth


def receive(stream: BufferedIOBase, path: Path, promise: Declared, limits: Limits) -> None:
    """Write the promised bytes to a file.

    Raises:
        RefusedError: fewer came, or the disk is full.
        TimeoutError: as the stream does, or they come more slowly than `limits` allow.
    """
    left, start = promise.length, time.monotonic()
    try:
        with path.open("xb") as file:
            while left:
                piece = stream.read1(min(PIECE, left))
                if not piece:
                    raise RefusedError(HTTPStatus.BAD_REQUEST, f"{promise.name}: only a part of it has come")
                left -= len(piece)
                file.write(piece)
                if time.monotonic() - start > limits.upload:
                    raise TimeoutError("the client is too slow")
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
