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
from spackle.core.photo import PHOTO_SUFFIXES
from spackle.depth.readers import DEPTH_SUFFIXES
from spackle.runtime.errors import InputError, first_validation_problem, printable_line
from spackle.web.jobs import Job, Jobs
from spackle.web.work import PREVIEW, SceneOptions, check_photo

MAX_NAME_CHARACTERS = 80
BINARY_FILE = {"type": "string", "format": "binary"}
# The form in the description of the HTTP interface. It is not declared as a parameter, because
# FastAPI would then read it before the queue has a place.
UPLOAD_FORM: dict[str, Any] = {
    "schema": {
        "type": "object",
        "required": ["photo"],
        "properties": {
            "photo": {**BINARY_FILE, "description": f"One of {', '.join(PHOTO_SUFFIXES)}."},
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

    photo_file = store_upload(photo, upload_folder, "source", photo_name, PHOTO_SUFFIXES)
    depth = form.get("depth")
    depth_file = None
    # A browser sends an empty field without a name if no file was chosen.
    if isinstance(depth, UploadFile) and depth.filename:
        depth_file = store_upload(depth, upload_folder, "depth", "depth map", DEPTH_SUFFIXES)

    # Only decoding shows whether a file is a photo; its suffix proves nothing.
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


def store_upload(
    upload: UploadFile, folder: Path, stem: str, shown_name: str, suffixes: tuple[str, ...]
) -> str:
    """Store an uploaded file under a name that the client cannot choose; returns this name.

    Args:
        upload: the file.
        folder: where to store it.
        stem: its new name without the suffix, which comes from the client.
        shown_name: what messages call the file.
        suffixes: accepted suffixes, such as ".jpg".

    Raises:
        HTTPException: 415 for another suffix, 400 for an empty file.
    """
    suffix = PurePosixPath(upload.filename or "").suffix.lower()
    if suffix not in suffixes:
        raise HTTPException(
            415, f"{shown_name}: this kind of file is not accepted: give {', '.join(suffixes)}"
        )
    if not upload.size:
        raise HTTPException(400, f"{shown_name}: the file is empty")

    # "x" refuses to overwrite: the folder is new, so nothing can have this name.
    stored_name = f"{stem}{suffix}"
    with (folder / stored_name).open("xb") as file:
        shutil.copyfileobj(upload.file, file)
    return stored_name


def safe_display_name(file_name: str) -> str:
    """The last part of a file's name, safe to show in terminals, pages and logs.

    Characters that cannot be printed are left out, because a terminal would obey control
    characters. Of a long name, the last `MAX_NAME_CHARACTERS` characters are kept: the end has the
    suffix.
    """
    last_part = re.split(r"[/\\]", file_name)[-1]
    printable = "".join(character for character in last_part if character.isprintable())
    return printable.strip()[-MAX_NAME_CHARACTERS:]
