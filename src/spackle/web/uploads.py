"""What a client sends, which is checked here: a photo with its depth map, or an edit of a scene."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
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
from spackle.formats.camera_files import CameraEntry, camera_from_json
from spackle.runtime.errors import InputError, printable_line, unknown_name
from spackle.runtime.validation import validation_problem
from spackle.web.decoding import DecodingTask, MaskCheck, PhotoCheck
from spackle.web.description import BINARY_FILE, describe_form
from spackle.web.edits import EDIT_SOURCE, FORMER_PAGE, MASK_FILE
from spackle.web.failures import refusal_of
from spackle.web.jobs import Edit, Job, Jobs, Submission
from spackle.web.work import PAGE, PREVIEW, SCENE_FILE, SceneOptions

MAX_NAME_CHARACTERS = 80
MAX_VIEWS = 32  # of a fill
MAX_VIEW_PIXELS = 4_000_000  # of a view, as for photos of Spackle's working size
MODEL = TypeVar("MODEL", bound=BaseModel)
DEPTH_NAME = "depth map"  # what messages call an uploaded depth map
PHOTO_DESCRIPTION = (
    "A photo; its content decides, not its name. The usual names end in "
    f"{', '.join(PHOTO_SUFFIXES)}."
)


class FillRequest(BaseModel):
    """Options of a fill."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cameras: list[CameraEntry] = Field(
        min_length=1,
        max_length=MAX_VIEWS,
        description="The views to fill, in the scene's world: each has K in pixels, "
        "world_to_camera (OpenCV: x right, y down, z forward), width and height.",
    )


class RemovalRequest(BaseModel):
    """Options of a removal."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    camera: CameraEntry = Field(
        description="The view in which the mask was drawn, in the scene's world: K in pixels, "
        "world_to_camera (OpenCV: x right, y down, z forward), width and height."
    )


# The forms in the description of the HTTP interface. They are not declared as parameters, because
# FastAPI would then read a form before the queue has a place.
UPLOAD_FORM = describe_form(
    SceneOptions,
    "photo",
    photo={**BINARY_FILE, "description": PHOTO_DESCRIPTION},
    depth={**BINARY_FILE, "description": f"Its depth map, one of {', '.join(DEPTH_SUFFIXES)}."},
)
FILL_FORM = describe_form(FillRequest, "options")
MASK_FIELD = {
    **BINARY_FILE,
    "description": "A picture of the view's shape: white where the thing is, "
    "black or transparent elsewhere.",
}
REMOVAL_FORM = describe_form(RemovalRequest, "mask", "options", mask=MASK_FIELD)
FORM_MODELS = (SceneOptions, FillRequest, RemovalRequest)  # of the fields `options`


def accept_photo(
    form: FormData,
    upload_folder: Path,
    jobs: Jobs,
    submission: Submission,
    *,
    bases: list[str],
) -> Job:
    """Store a form's photo, check that it can be decoded, and queue it; returns its job.

    Args:
        form: `photo` (a file), and perhaps `depth` (a file) and `options` (JSON).
        upload_folder: an empty folder for the files, which `jobs` has reserved.
        jobs: receives the new job.
        submission: who has sent the form.
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
    photo_check = PhotoCheck(
        path=upload_folder / photo_file, name=photo_name, preview=upload_folder / PREVIEW
    )
    _decode(photo_check, photo_name, jobs)
    # Options that the client has not set stay away, so that the server's defaults apply to them.
    given_options = options.model_dump(exclude_unset=True)
    return jobs.add(
        upload_folder,
        name=photo_name,
        source=photo_file,
        depth=depth_file,
        options=given_options,
        submission=submission,
    )


def accept_fill(
    form: FormData,
    upload_folder: Path,
    jobs: Jobs,
    submission: Submission,
    *,
    parent: Job,
) -> Job:
    """Check a form that asks for a fill of a finished scene, and queue it; returns its job.

    HTTPException 422 for a form without cameras, or with impossible ones.
    """
    request = _edit_options(form, FillRequest)
    cameras = [camera.model_dump() for camera in request.cameras]
    for index, camera in enumerate(cameras):
        _check_view(camera, f"cameras.{index}")
    edit = Edit("fill", parent.id, cameras)
    return _add_edit(edit, upload_folder, jobs, parent, submission)


def accept_removal(
    form: FormData,
    upload_folder: Path,
    jobs: Jobs,
    submission: Submission,
    *,
    parent: Job,
) -> Job:
    """Check a form with the mask of a thing in a finished scene, and queue it; returns its job.

    HTTPException 422 for a form without mask or camera, or with an impossible camera; 415 for a
    mask that is no picture of the view's shape, or that marks nothing or everything.
    """
    request = _edit_options(form, RemovalRequest)
    camera = request.camera.model_dump()
    _check_view(camera, "camera")
    mask = form.get("mask")
    if not isinstance(mask, UploadFile):
        raise HTTPException(422, "send the mask as the file `mask`")
    store_upload(mask, upload_folder, MASK_FILE)
    _decode(MaskCheck(path=upload_folder / MASK_FILE, camera=camera), "mask", jobs)
    edit = Edit("remove", parent.id, [camera], MASK_FILE)
    return _add_edit(edit, upload_folder, jobs, parent, submission)


def _decode(task: DecodingTask, name: str, jobs: Jobs) -> None:
    """Decode a stored file in a process of its own.

    HTTPException: 415 if the file called `name` is damaged, or takes too much time or memory; 507
    if this machine's disk is full.
    """
    failure = jobs.decode(task)
    if failure is None:
        return
    if failure.kind in ("time", "memory", "died"):
        failure = failure._replace(line=f"{name}: cannot be decoded: {failure.line}")
    raise refusal_of(failure, 415)


def _edit_options(form: FormData, model: type[MODEL]) -> MODEL:
    """The field `options` of a form, checked; HTTPException 422 if it is missing or bad."""
    text = form.get("options")
    if not isinstance(text, str):
        raise HTTPException(422, "send the options as the text `options`")
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        problem = printable_line(f"options: {validation_problem(model, error)}")
        raise HTTPException(422, problem) from error


def _check_view(camera: dict[str, Any], where: str) -> None:
    """HTTPException 422 for a camera that is impossible or has too many pixels."""
    try:
        view = camera_from_json(camera, f"options: {where}")
    except InputError as error:
        raise HTTPException(422, printable_line(str(error))) from error
    if view.width * view.height > MAX_VIEW_PIXELS:
        problem = f"{view.width}×{view.height} are too many pixels"
        limit = f"{MAX_VIEW_PIXELS / 1e6:g} million"
        raise HTTPException(422, f"options: {where}: {problem}: at most {limit}")


def _add_edit(
    edit: Edit, upload_folder: Path, jobs: Jobs, parent: Job, submission: Submission
) -> Job:
    """Queue an edit of a scene, with files of its own; returns its job.

    HTTPException 409 if the scene has been deleted meanwhile.
    """
    try:
        # The edit must not depend on how long its parent is kept.
        _link_or_copy(parent.results / SCENE_FILE, upload_folder / EDIT_SOURCE)
        _link_or_copy(parent.results / PAGE, upload_folder / FORMER_PAGE)
    except FileNotFoundError:
        raise HTTPException(409, "this scene has been deleted") from None
    return jobs.add(
        upload_folder,
        name=parent.name,
        source=EDIT_SOURCE,
        depth=None,
        # The options for videos, such as the trajectory, hold for the edited scene, too. Its files
        # are made when somebody asks for them.
        options={**parent.options, "files": []},
        edit=edit,
        submission=submission,
    )


def _link_or_copy(source: Path, target: Path) -> None:
    """Another name for a file, or a copy where the disk has no such names.

    Nobody changes a file of results: a new one is written and takes its name.
    """
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)


def read_options(text: str, bases: list[str]) -> SceneOptions:
    """The options of a JSON text; HTTPException 422 if one is unknown or has a bad value.

    A base, the network for a photo's geometry, must be among `bases`. Another is refused with the
    reason: the name is unknown, or its weights are not on this server.
    """
    try:
        options = SceneOptions.model_validate_json(text)
    except ValidationError as error:
        problem = printable_line(f"options: {validation_problem(SceneOptions, error)}")
        raise HTTPException(422, problem) from error

    if options.base is not None and options.base not in bases:
        reason = MISSING_WEIGHTS_ADVICE.get(options.base) or unknown_name(options.base, bases)
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
