"""Formats of photos, told from the first bytes of a file.

`kind_of_file` names what a file is; `list_photos` finds the photos of a folder, and what else lies
there. The name of a file proves nothing: phones write .jfif and .HIF, and a .jpg may be anything.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file, list_files

HEAD_BYTES = 64  # the first bytes of a file, which tell its format
EXPORT_ADVICE = "export it as JPEG, PNG, WebP, HEIC, AVIF or TIFF"
MAX_LISTED_NAMES = 3  # of files that are left out; all others are only counted


@dataclasses.dataclass(frozen=True)
class FileKind:
    """A format of files."""

    name: str  # for messages, such as "JPEG"
    pillow: str | None = None  # Pillow's name of the decoder; None: no photo that Pillow reads
    suffixes: tuple[str, ...] = ()  # in lower case; the first one is the usual one
    is_raw: bool = False  # the data of a sensor, with a preview inside
    is_video: bool = False
    advice: str = EXPORT_ADVICE  # what to do with a file of this format that is no photo

    @property
    def is_photo(self) -> bool:
        """Whether a file of this format can be read as a photo."""
        return self.pillow is not None or self.is_raw


JPEG = FileKind("JPEG", "JPEG", (".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".mpo"))
PNG = FileKind("PNG", "PNG", (".png", ".apng"))
WEBP = FileKind("WebP", "WEBP", (".webp",))
HEIF = FileKind("HEIF", "HEIF", (".heic", ".heif", ".hif", ".heics", ".heifs"))
AVIF = FileKind("AVIF", "AVIF", (".avif", ".avifs"))
TIFF = FileKind("TIFF", "TIFF", (".tif", ".tiff"))
GIF = FileKind("GIF", "GIF", (".gif",))
BMP = FileKind("BMP", "BMP", (".bmp", ".dib"))
PNM = FileKind("PNM", "PPM", (".ppm", ".pgm", ".pbm", ".pnm", ".pfm"))
# Raw files that are TIFFs are told by what is in them, so most suffixes have no first bytes.
RAW = FileKind(
    "raw",
    suffixes=(
        *(".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2"),
        *(".pef", ".srw", ".3fr", ".fff", ".iiq", ".erf", ".mef", ".mos", ".dcr", ".kdc", ".rwl"),
        *(".x3f", ".gpr"),
    ),
    is_raw=True,
)
PHOTO_KINDS = (JPEG, PNG, WEBP, HEIF, AVIF, TIFF, GIF, BMP, PNM, RAW)

# What the names of photos usually end in: for the page's list of files, and to know a damaged photo
# from a file of another kind. A name decides nothing else. A PFM is a depth map.
PHOTO_SUFFIXES = tuple(
    suffix for kind in PHOTO_KINDS for suffix in kind.suffixes if suffix != ".pfm"
)

VIDEO = FileKind("video", is_video=True)

# What stands in place of a file that was not fetched.
GIT_LFS = FileKind("pointer of Git LFS", advice="fetch the file itself: `git lfs pull`")
WEB_PAGE = FileKind("HTML", advice="it is a web page: download the file itself")

# Formats by their first bytes. The longest ones come first, because some begin alike.
_MAGIC: tuple[tuple[bytes, FileKind], ...] = (
    (b"FUJIFILMCCD-RAW", RAW),
    (b"version https://git-lfs", GIT_LFS),
    (b"\x00\x00\x00\x0cJXL \r\n\x87\n", FileKind("JPEG XL")),
    (b"\x00\x00\x00\x0cjP  \r\n\x87\n", FileKind("JPEG 2000")),
    (b"\x89PNG\r\n\x1a\n", PNG),
    (b"#?RADIANCE", FileKind("Radiance HDR")),
    (b"GIF87a", GIF),
    (b"GIF89a", GIF),
    (b"\xff\x4f\xff\x51", FileKind("JPEG 2000")),
    (b"\xc5\xd0\xd3\xc6", FileKind("PostScript")),
    (b"\x76\x2f\x31\x01", FileKind("OpenEXR")),
    (
        b"\x00\x05\x16\x07",
        FileKind("AppleDouble", advice="leave it out: macOS keeps notes about another file in it"),
    ),
    (b"\x1a\x45\xdf\xa3", VIDEO),  # Matroska and WebM
    (b"II*\x00", TIFF),
    (b"MM\x00*", TIFF),
    (b"II+\x00", TIFF),  # BigTIFF
    (b"MM\x00+", TIFF),
    (b"IIRO", RAW),  # Olympus
    (b"IIRS", RAW),
    (b"MMOR", RAW),
    (b"IIU\x00", RAW),  # Panasonic and Leica
    (b"FOVb", RAW),  # Sigma
    (b"\x00MRM", RAW),  # Minolta
    (b"II\x1a\x00", RAW),  # the first Canon
    (b"II\xbc\x01", FileKind("JPEG XR")),
    (b"8BPS", FileKind("Photoshop")),
    (b"%!PS", FileKind("PostScript")),
    (b"%PDF", FileKind("PDF")),
    (b"PK\x03\x04", FileKind("ZIP")),
    (b"qoif", FileKind("QOI")),
    (b"\xff\xd8\xff", JPEG),
    (b"\xff\x0a", FileKind("JPEG XL")),
    (b"BM", BMP),
)
_PNM_MAGIC = tuple(b"P%c" % letter for letter in b"123456Ff")
_MARKUP = (
    (b"<svg", FileKind("SVG")),
    (b"<!doctype html", WEB_PAGE),
    (b"<html", WEB_PAGE),
)
UNKNOWN = FileKind("unknown")

# Brands of files that are made of boxes, whose first box is `ftyp`.
_AVIF_BRANDS = {b"avif", b"avis"}
_HEIF_BRANDS = {
    *(b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"),
    *(b"mif2", b"miaf"),
}


def kind_of_bytes(head: bytes) -> FileKind:
    """The format of a file that begins with these bytes; 64 are enough.

    A raw file that is a TIFF counts as TIFF, because only its content shows what it is.
    """
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    # RIFF is a container; behind its size (4 bytes) stands what it contains.
    if head.startswith(b"RIFF"):
        return {b"WEBP": WEBP, b"AVI ": VIDEO}.get(head[8:12], FileKind("RIFF"))
    if head[4:8] == b"ftyp":
        return _kind_of_brands(head)
    # "P6" alone would also fit a text; a space or a comment follows in every file of this kind.
    if head.startswith(_PNM_MAGIC) and head[2:3] in (b" ", b"\n", b"\r", b"\t", b"#"):
        return PNM
    # Texts such as HTML, without the byte order mark and blanks that may stand before them.
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t").lower()
    for beginning, kind in _MARKUP:
        if text.startswith(beginning):
            return kind
    return UNKNOWN


def _kind_of_brands(head: bytes) -> FileKind:
    """The format of a file whose first box is `ftyp`: a HEIF, an AVIF, a raw file or a video.

    The box holds the main brand (4 bytes), a version (4 bytes) and all brands that the file suits.
    """
    size = int.from_bytes(head[:4], "big")
    content = head[8 : min(size, len(head))]
    main_brand = content[:4]
    # "mif1" says only that the file is a HEIF of some kind; the other brands then tell which codec
    # it has.
    brands = {content[start : start + 4] for start in range(8, len(content) - 3, 4)}
    if main_brand == b"crx ":  # Canon
        return RAW
    if main_brand in _AVIF_BRANDS:
        return AVIF
    is_heif = main_brand in _HEIF_BRANDS
    if is_heif and brands & _AVIF_BRANDS and not brands & {b"heic", b"heix"}:
        return AVIF
    return HEIF if is_heif else VIDEO


def kind_of_file(path: str | os.PathLike[str]) -> FileKind:
    """The format of a file by its first bytes; InputError if the file cannot be read."""
    check_file(path, "file")  # opening a named pipe would wait for somebody who writes into it
    with as_input_error(path, "cannot be read: {reason}", OSError), open(path, "rb") as file:
        return kind_of_bytes(file.read(HEAD_BYTES))


def not_a_photo(path: str | os.PathLike[str], kind: FileKind) -> InputError:
    """The error for a file of a format that is no photo's."""
    what = "not an image of a known format" if kind is UNKNOWN else f"a {kind.name} file, no photo"
    return InputError(f"{path}: {what}: {kind.advice}")


def list_photos(
    folder: Path,
    *,
    below: bool = False,
    without: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> list[Path]:
    """The sorted photos of a folder, told by their content, whatever their names end in.

    A damaged file with a photo's suffix is in the list, too, so that its reader says what is wrong.

    Args:
        folder: the folder; hidden files in it are passed over.
        below: also list the photos of the visible subfolders, but not of those that are links.
        without: a folder that is passed over, such as that of the results.
        log: receives a line that names and counts the files that are left out, and one for
            subfolders that are links.

    Raises:
        InputError: the folder cannot be read.
    """
    photos: list[Path] = []
    left_out: list[Path] = []
    links: list[Path] = []
    for file in list_files(folder, ("",), below=below, without=without, links=links):
        # A usual suffix saves opening the file, which takes long for many files on a server.
        is_photo = file.name.lower().endswith(PHOTO_SUFFIXES) or _looks_like_photo(file)
        if is_photo:
            photos.append(file)
        else:
            left_out.append(file)
    if left_out and log is not None:
        log(f"{folder}: {describe_left_out(left_out, folder)}")
    if links and log is not None:
        names = _first_names(sorted(links), folder)
        log(
            f"{folder}: subfolders that are links are left out, {names}: "
            "give them as folders of their own"
        )
    return photos


def _looks_like_photo(path: Path) -> bool:
    """Whether a file begins as a photo does; false for one that cannot be read.

    A PFM, which is a format of PNM, is a depth map.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return kind_of_bytes(head).is_photo and not head.startswith((b"PF", b"Pf"))


def describe_left_out(files: Sequence[Path], folder: Path) -> str:
    """A line that counts the files of a folder that are no photos, and names the first of them."""
    count = len(files)
    listed = _first_names(files, folder)
    if count == 1:
        return f"1 file is no photo, and is left out: {listed}"
    return f"{count} files are no photos, and are left out: {listed}"


def _first_names(files: Sequence[Path], folder: Path) -> str:
    """The names of the first files, relative to their folder, and the number of the others."""
    names = [file.relative_to(folder).as_posix() for file in files[:MAX_LISTED_NAMES]]
    listed = ", ".join(names)
    more_count = len(files) - len(names)
    return f"{listed} and {more_count} more" if more_count else listed
