"""The app: the page, and the HTTP interface, which the page uses, too. Read `create_app`."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
from collections.abc import AsyncIterator, Callable
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response
from fastapi.sse import EventSourceResponse
from jinja2 import Template
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.staticfiles import StaticFiles
from uvicorn.protocols.http.h11_impl import H11Protocol

import spackle
from spackle.bases.settings import AUTO, MISSING_WEIGHTS_ADVICE
from spackle.core.photo import PHOTO_SUFFIXES
from spackle.depth.readers import DEPTH_SUFFIXES
from spackle.formats.html import read_page_file
from spackle.runtime.errors import InputError, first_validation_problem, printable_line
from spackle.runtime.task_process import TaskFunction
from spackle.web.guard import MAX_UPLOAD_BYTES, Access, Guard
from spackle.web.jobs import Job, Jobs, RetentionLimits, SceneState
from spackle.web.work import (
    PREVIEW,
    Download,
    FileName,
    SceneOptions,
    SceneWork,
    Video,
    check_photo,
)

PagePart = Literal[
    "page.json", "base.splats", "aux.splats", "photo.jpg"
]  # files that the page draws
SCENES_PATH = "/api/v1/scenes"
LISTED_FILES = sorted([PREVIEW, *get_args(Download), *get_args(Video)])  # files that a state lists
POLL_S = 0.1  # seconds between two checks whether a state has changed
MAX_UPLOAD_S = 300.0  # seconds that an upload may take, because it holds a place in the queue
MAX_NAME_CHARACTERS = 80  # characters
MAX_CONNECTIONS = 512  # open at a time; further ones are refused
MAX_HEAD_S = 10.0  # seconds that a client may take to send the head of a request
DEFAULT_WORK = SceneWork()
DEFAULT_LIMITS = RetentionLimits()
BINARY_FILE = {"type": "string", "format": "binary"}
UPLOAD_FORM: dict[
    str, Any
] = {  # not declared as a form: FastAPI would read it before the queue has a place
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


def create_app(
    folder: Path,
    work: TaskFunction = DEFAULT_WORK,
    *,
    workers: int = 1,
    keep: RetentionLimits = DEFAULT_LIMITS,
    access: Access | None = None,
    max_bytes: int = MAX_UPLOAD_BYTES,
) -> FastAPI:
    """An app to serve alone, or to mount in another app, which must then control access.

    The worker processes start at once and end with the app; if another app mounts this one, call
    `app.state.jobs.close()` at the end. Unfinished photos resume when an app next opens the folder.

    Args:
        folder: folder of photos and scenes; InputError if another server uses it.
        work: the function with which a worker process completes a photo.
        workers: number of processes, each of which holds the base's network.
        keep: limits of the folder: age and size of scenes, and number of waiting photos.
        access: token and host that requests are checked against; None leaves checks to the caller.
        max_bytes: size limit of an upload, including its depth map.
    """
    jobs = Jobs(folder, work, workers, keep)
    bases: Callable[[], list[str]] = getattr(work, "bases", lambda: [AUTO])

    @contextlib.asynccontextmanager
    async def until_the_end(app: FastAPI) -> AsyncIterator[None]:
        yield
        jobs.close()

    app = FastAPI(
        title="Spackle",
        version=spackle.__version__,
        openapi_url="/api/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=until_the_end,
        exception_handlers=dict.fromkeys((HTTPException, RequestValidationError), error_answer),
    )
    app.state.jobs = jobs
    app.add_middleware(Guard, access=access, max_bytes=max_bytes)
    decoding = asyncio.Lock()  # one photo at a time: decoding a large one takes a gigabyte

    def path_of(job: Job, file: str) -> Path:
        return (job.folder if file == PREVIEW else job.results) / file

    def with_files(job: Job) -> SceneState:
        return job.model_copy(
            update={"files": [file for file in LISTED_FILES if path_of(job, file).is_file()]}
        )

    def job_of(id: str) -> Job:
        if (job := jobs.by_id.get(id)) is None:
            raise HTTPException(404, "there is no such scene")
        return job

    @app.post(
        SCENES_PATH,
        status_code=202,
        openapi_extra={"requestBody": {"content": {"multipart/form-data": UPLOAD_FORM}}},
    )
    async def post_photo(request: Request, response: Response) -> SceneState:
        """Send a photo. The photo is queued; if the queue is full, the answer is 429."""
        with jobs.reserve_place() as new:
            try:
                form = await asyncio.wait_for(request.form(max_files=2, max_fields=1), MAX_UPLOAD_S)
            except asyncio.TimeoutError:
                raise HTTPException(408, "the photo arrived too slowly") from None
            try:
                async with decoding:
                    job = await run_in_threadpool(accept_photo, form, new, jobs, bases())
            finally:
                await form.close()
        response.headers["Location"] = f"{request.scope['root_path']}{SCENES_PATH}/{job.id}"
        return job

    @app.get(SCENES_PATH + "/{id}")
    async def get_state(id: str) -> SceneState:
        """The state of a photo and its files."""
        return with_files(job_of(id))

    @app.delete(SCENES_PATH + "/{id}", status_code=204)
    async def delete(id: str) -> None:
        """Delete a photo and its scene, and end work on it."""
        await run_in_threadpool(jobs.remove, job_of(id).id)

    @app.get(SCENES_PATH + "/{id}/events", response_class=EventSourceResponse)
    async def get_events(id: str) -> AsyncIterator[SceneState]:
        """Server-sent events: the state, now and whenever it changes, until the photo is done or failed."""
        seen: Job | None = None
        while seen is None or seen.ended is None:
            if (state := jobs.by_id.get(id)) is None:
                yield SceneState(
                    id=id, name="", state="failed", error="there is no such scene", ended=0
                )
                return
            if state is not seen:
                seen = state
                yield with_files(state)
            await asyncio.sleep(POLL_S)

    @app.get(SCENES_PATH + "/{id}/files/{file}", response_class=FileResponse)
    async def get_file(id: str, file: FileName | PagePart) -> FileResponse:
        """A file of a finished scene; a file that does not exist yet is made on demand."""
        job = job_of(id)
        path = path_of(job, file)
        if not path.is_file():
            if job.state != "done":
                raise HTTPException(409, job.error or "this scene is not done yet")
            if file in get_args(PagePart):
                raise HTTPException(404, "this file exists only for photos, and a scene was opened")
            if error := await asyncio.shield(asyncio.wrap_future(jobs.make_file(job, file))):
                raise HTTPException(404, error)
        return FileResponse(path, filename=PurePosixPath(job.name).stem + path.suffix)

    @app.get("/page.json", include_in_schema=False)
    async def get_page_state() -> dict[str, object]:
        writes = access is None or access.token is not None
        upload = (
            {"suffixes": PHOTO_SUFFIXES, "max_bytes": max_bytes, "bases": bases()}
            if writes
            else None
        )
        return {"upload": upload}

    @app.get("/healthz", include_in_schema=False)
    async def get_health() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/docs", include_in_schema=False)
    async def get_docs() -> HTMLResponse:
        return HTMLResponse(
            Template(read_page_file("docs.html").decode(), autoescape=True).render(
                api=app.openapi()
            )
        )

    app.mount("/", StaticFiles(packages=[("spackle.web", "page")], html=True))
    return app


def accept_photo(form: FormData, folder: Path, jobs: Jobs, bases: list[str]) -> Job:
    """Decode a form's photo and add its job; HTTPException for a bad form or a file that is no photo."""
    photo, depth, text = form.get("photo"), form.get("depth"), form.get("options") or "{}"
    if (
        len(form.getlist("photo")) != 1
        or not isinstance(photo, UploadFile)
        or not isinstance(text, str)
    ):
        raise HTTPException(
            422, "send one photo as the file `photo`, and the options as the text `options`"
        )
    name = safe_display_name(photo.filename or "")
    try:
        options = SceneOptions.model_validate_json(text)
    except ValidationError as error:
        raise HTTPException(
            422, printable_line(f"options: {first_validation_problem(error)}")
        ) from error
    if options.base not in (None, *bases):
        why = MISSING_WEIGHTS_ADVICE.get(
            options.base or "", f"unknown: there are {', '.join(bases)}"
        )
        raise HTTPException(422, printable_line(f"base {options.base} on this server: {why}"))
    source, of_depth = store_upload(photo, folder, "source", name, PHOTO_SUFFIXES), None
    if isinstance(depth, UploadFile) and depth.filename:
        of_depth = store_upload(depth, folder, "depth", "depth map", DEPTH_SUFFIXES)
    try:
        check_photo(folder / source, name, folder / PREVIEW)
    except InputError as error:
        raise HTTPException(415, str(error)) from error
    return jobs.add(folder, name, source, of_depth, options.model_dump(exclude_unset=True))


def store_upload(
    upload: UploadFile, folder: Path, stem: str, name: str, suffixes: tuple[str, ...]
) -> str:
    """Store an upload under a safe name."""
    suffix = PurePosixPath(upload.filename or "").suffix.lower()
    if suffix not in suffixes:
        raise HTTPException(
            415, f"{name}: this kind of file is not accepted: give {', '.join(suffixes)}"
        )
    if not upload.size:
        raise HTTPException(400, f"{name}: the file is empty")
    with (folder / f"{stem}{suffix}").open("xb") as file:
        shutil.copyfileobj(upload.file, file)
    return f"{stem}{suffix}"


def safe_display_name(given: str) -> str:
    """The last part of a file's name, without characters that are unsafe in terminals, pages and logs."""
    last = re.split(r"[/\\]", given)[-1]
    return "".join(character for character in last if character.isprintable()).strip()[
        -MAX_NAME_CHARACTERS:
    ]


async def error_answer(request: Request, error: Any) -> JSONResponse:
    """The answer to a refused request, with the reason in one line."""
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    return JSONResponse({"error": "there is nothing with that name"}, 404)


def make_server(app: FastAPI) -> uvicorn.Server:
    """A server whose `run(sockets=[listener])` serves until Ctrl-C or SIGTERM; then the app's processes end."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=PatientProtocol,
            ws="none",
            log_config=None,
            log_level="critical",
            server_header=False,
            proxy_headers=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=1,  # seconds for clients that still watch a photo
        )
    )


class PatientProtocol(H11Protocol):
    """Closes the connection of a client that sends no complete head of a request for a while."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._check(self)

    def _check(self, before: object) -> None:
        waiting = self.cycle is None or self.cycle.response_complete
        if self.transport.is_closing() or (waiting and self.cycle is before):
            self.transport.abort()  # `close` would first send data that nobody reads
        else:
            self.loop.call_later(MAX_HEAD_S, self._check, self.cycle if waiting else self)
