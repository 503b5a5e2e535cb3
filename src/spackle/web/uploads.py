"""What a client sends: a form with a photo, its depth map and options, which is checked here."""

from __future__ import annotations

import re
import shutil
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException

from spackle.bases.settings import MISSING_WEIGHTS_ADVICE
from spackle.core.image_formats import (
    HEAD_BYTES,
    PHOTO_SUFFIXES,
    FileKind,
    kind_of_bytes,
    not_a_photo,
)
from spackle.depth.readers import DEPTH_SUFFIXES
from spackle.runtime.errors import InputError, first_validation_problem, printable_line
from spackle.web.jobs import Job, Jobs
from spackle.web.work import PREVIEW, SceneOptions, check_photo

MAX_NAME_CHARACTERS = 80
DEPTH_NAME = "depth map"  # what messages call an uploaded depth map
PHOTO_DESCRIPTION = (
    "A photo; its content decides, not its name. The usual names end in "
    f"{', '.join(PHOTO_SUFFIXES)}."
)
BINARY_FILE = {"type": "string", "format": "binary"}
# The form in the description of the HTTP interface. It is not declared as a parameter, because
# FastAPI would then read it before the queue has a place.
UPLOAD_FORM: dict[str, Any] = {
    "schema": {
        "type": "object",
        "required": ["photo"],
        "properties": {
            "photo": {**BINARY_FILE, "description": PHOTO_DESCRIPTION},
            "depth": {
                **BINARY_FILE,
                "description": f"Its depth map, one of {', '.join(DEPTH_SUFFIXES)}.",
            },
            "options": SceneOptions.model_json_schema(),
        },
    },
    "encoding": {"options": {"contentType": "application/json"}},
}


def accept_photo(form: FormData, upload_folder: Path, jobs: Jobs, bases: list[str]) -> Job:
    """Store a form's photo, check that it can be decoded, and queue it; returns its job.

    Args:
        form: `photo` (a file), and perhaps `depth` (a file) and `options` (JSON).
        upload_folder: an empty folder for the files, which `jobs` has reserved.
        jobs: receives the new job.
        bases: the names of the bases, the networks for a photo's geometry, that may be chosen.

    Raises:
        HTTPException: 422 for a bad form or bad options, 400 for an empty file, 415 for a file that
            is no photo of an accepted kind.
    """
    # A form may hold anything: several photos, text in place of a file, a file in place of text.
    photo = form.get("photo")
    options_text = form.get("options") or "{}"
    is_one_photo = isinstance(photo, UploadFile) and len(form.getlist("photo")) == 1
    if not is_one_photo or not isinstance(options_text, str):
        raise HTTPException(
            422, "send one photo as the file `photo`, and the options as the text `options`"
        )
    assert isinstance(photo, UploadFile)  # tells the type checker what is already known
    photo_name = safe_display_name(photo.filename or "")
    options = read_options(options_text, bases)

    photo_file = store_upload(photo, upload_folder, f"source{photo_suffix(photo, photo_name)}")
    depth = form.get("depth")
    depth_file = None
    # A browser sends an empty field without a name if no file was chosen.
    if isinstance(depth, UploadFile) and depth.filename:
        depth_file = store_upload(depth, upload_folder, f"depth{depth_suffix(depth)}")

    # Only decoding shows whether a photo is whole.
    try:
        check_photo(upload_folder / photo_file, photo_name, upload_folder / PREVIEW)
    except InputError as error:
        raise HTTPException(415, str(error)) from error
    # Options that the client has not set stay away, so that the server's defaults apply to them.
    given_options = options.model_dump(exclude_unset=True)
    return jobs.add(
        upload_folder,
        name=photo_name,
        source=photo_file,
        depth=depth_file,
        options=given_options,
    )


def read_options(text: str, bases: list[str]) -> SceneOptions:
    """The options of a JSON text; HTTPException 422 if one is unknown or has a bad value.

    A base, the network for a photo's geometry, must be among `bases`. Another is refused with the
    reason: the name is unknown, or its weights are not on this server.
    """
    try:
        options = SceneOptions.model_validate_json(text)
    except ValidationError as error:
        problem = printable_line(f"options: {first_validation_problem(error)}")
        raise HTTPException(422, problem) from error

    if options.base is not None and options.base not in bases:
        unknown = f"unknown: there are {', '.join(bases)}"
        reason = MISSING_WEIGHTS_ADVICE.get(options.base, unknown)
        raise HTTPException(422, printable_line(f"base {options.base} on this server: {reason}"))
    return options


def photo_suffix(upload: UploadFile, shown_name: str) -> str:
    """The usual suffix of the format that an uploaded photo has by its content, such as ".jpg".

    HTTPException: 415 for a file that is no photo, 400 for an empty file.
    """
    kind = _kind_of_upload(upload, shown_name)
    if not kind.is_photo:
        raise HTTPException(415, str(not_a_photo(shown_name, kind)))
    return kind.suffixes[0]


def depth_suffix(upload: UploadFile) -> str:
    """The suffix under which an uploaded depth map is stored.

    HTTPException: 415 for a file that is neither a depth map nor a picture, which holds relative
    depth; 400 for an empty file.
    """
    kind = _kind_of_upload(upload, DEPTH_NAME)
    suffix = PurePosixPath(upload.filename or "").suffix.lower()
    if suffix in DEPTH_SUFFIXES:
        return suffix
    if kind.is_photo:
        return kind.suffixes[0]
    raise HTTPException(
        415, f"{DEPTH_NAME}: this kind of file is not accepted: give {', '.join(DEPTH_SUFFIXES)}"
    )


def _kind_of_upload(upload: UploadFile, shown_name: str) -> FileKind:
    """The format of an uploaded file by its first bytes; HTTPException 400 for an empty file."""
    if not upload.size:
        raise HTTPException(400, f"{shown_name}: the file is empty")
    upload.file.seek(0)
    head = upload.file.read(HEAD_BYTES)
    upload.file.seek(0)
    return kind_of_bytes(head)


def store_upload(upload: UploadFile, folder: Path, name: str) -> str:
    """Store an uploaded file in a folder as `name`, which the client cannot choose; returns it."""
    # "x" refuses to overwrite: the folder is new, so nothing can have this name.
    with (folder / name).open("xb") as file:
        shutil.copyfileobj(upload.file, file)
    return name


def safe_display_name(file_name: str) -> str:
    """The last part of a file's name, safe to show in terminals, pages and logs.

    Characters that cannot be printed are left out, because a terminal would obey control
    characters. Of a long name, the last `MAX_NAME_CHARACTERS` characters are kept: the end has the
    suffix.
    """
    last_part = re.split(r"[/\\]", file_name)[-1]
    printable = "".join(character for character in last_part if character.isprintable())
    return printable.strip()[-MAX_NAME_CHARACTERS:]
