"""The app: the page, and the HTTP interface, which the page uses, too. Read `create_app`.

`SceneHandlers` holds what answers the requests; `uploads.py` reads what a client sends.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, Literal, get_args

import uvicorn
from fastapi import Depends, FastAPI, Header, Query, Request
from fastapi.concurrency import contextmanager_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
)
from fastapi.sse import EventSourceResponse
from jinja2 import Template
from pydantic import BaseModel, Field
from python_multipart.multipart import parse_options_header
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.staticfiles import StaticFiles
from uvicorn.protocols.http.h11_impl import H11Protocol

import spackle
from spackle.bases.settings import AUTO
from spackle.core.image_formats import PHOTO_SUFFIXES
from spackle.formats.html import read_page_file, with_tags
from spackle.runtime.errors import InputError, printable_line
from spackle.runtime.task_process import TaskFunction
from spackle.web.better_depth import BetterDepth, FetchState
from spackle.web.callbacks import CallbackSender
from spackle.web.clients import OPERATOR, RateLimits, client_of, may_use
from spackle.web.description import (
    ACCEPTED,
    ANY_FORM,
    DELETED,
    FILE,
    HEALTH,
    LINK,
    MEDIA_TYPES,
    OCTETS,
    PAGE_OF_STATES,
    READY,
    STATE,
    DescribedApp,
    refusals,
    resolve,
)
from spackle.web.failures import as_no_space, refusal_of
from spackle.web.guard import (
    MAX_UPLOAD_BYTES,
    POLICY_HEADER,
    SECURITY_HEADERS,
    STRANGER,
    Access,
    Guard,
    outer_root,
)
from spackle.web.jobs import (
    DECODER_COUNT,
    Job,
    Jobs,
    RequestKey,
    RetentionLimits,
    SceneState,
    Submission,
    age_key,
    error_line,
)
from spackle.web.metrics import Metrics
from spackle.web.public_address import LOCAL_ONLY
from spackle.web.scene_links import MAX_CAPTION_LENGTH, SHARED_PATH, SceneLink, SceneLinks
from spackle.web.shared_videos import SharedVideo
from spackle.web.uploads import (
    FILL_FORM,
    FORM_MODELS,
    REMOVAL_FORM,
    UPLOAD_FORM,
    accept_fill,
    accept_photo,
    accept_removal,
)
from spackle.web.work import PREVIEW, Download, FileName, SceneWork, Video

SCENES_PATH = "/api/v1/scenes"
DOCS_PATH = "/api/v1/docs"
# What the page draws.
PagePart = Literal[
    "page.json",
    "base.splats",
    "base.harmonics",
    "aux.splats",
    "aux.harmonics",
    "photo.jpg",
]
# The files that a state lists if they exist.
LISTED_FILES = sorted([PREVIEW, *get_args(Download), *get_args(Video), *get_args(SharedVideo)])
POLL_S = 0.1  # seconds between two checks whether a state has changed
MAX_UPLOAD_S = 300.0  # seconds that an upload may take, because it holds a place in the queue
MAX_CONNECTIONS = 512  # open at a time; for a further one, an idle one is closed
MAX_HEAD_S = 10.0  # seconds that a client may take to send the head of a request
DEFAULT_PAGE_SIZE = 20  # states
MAX_PAGE_SIZE = 100
PAGE_FILE = "scene.html"
# Of a scene's page, whose own policy names its script and style and forbids everything else.
SHARED_HEADERS = {POLICY_HEADER: "frame-ancestors 'none'", "X-Robots-Tag": "noindex"}
BUSY = object()  # marks a connection that is not idle
DEFAULT_WORK = SceneWork()
DEFAULT_LIMITS = RetentionLimits()

IdempotencyKey = Annotated[
    str | None,
    Header(
        max_length=200,
        description="A name of the client's choice for its request: if it repeats the request, the "
        "answer is the state of the scene of the first one.",
    ),
]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Number of states of a page.")]
PageCaption = Annotated[
    str, Query(max_length=MAX_CAPTION_LENGTH, description="A text for below the scene's picture.")
]
PageMark = Annotated[
    str | None,
    Query(
        pattern=r"^[0-9]{1,12}(\.[0-9]{1,12})?-[0-9a-f]{16}$",
        description="The field `next` of the page before.",
    ),
]


class ScenePage(BaseModel):
    """A page of the list of scenes."""

    scenes: list[SceneState]
    next: str | None = Field(description="What the next page comes `after`; null for the last.")


class Health(BaseModel):
    """A server that runs."""

    status: Literal["ok"] = "ok"
    version: str | None = None
    base: str | None = Field(default=None, description="The network for photos that name none.")


class Readiness(BaseModel):
    """A server that can complete photos."""

    status: Literal["ready"] = "ready"


def create_app(
    folder: Path,
    work: TaskFunction = DEFAULT_WORK,
    *,
    workers: int = 1,
    keep: RetentionLimits = DEFAULT_LIMITS,
    access: Access | None = None,
    max_bytes: int = MAX_UPLOAD_BYTES,
    callbacks: CallbackSender | None = None,
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
        callbacks: tells clients' servers that scenes are done; None: it tells nobody.
    """
    jobs = Jobs(folder, work, workers, keep, callbacks)
    jobs.start_callbacks(state_with_files)

    @contextlib.asynccontextmanager
    async def close_jobs_at_the_end(app: FastAPI) -> AsyncIterator[None]:
        yield
        jobs.close()

    app = DescribedApp(
        title="Spackle",
        version=spackle.__version__,
        openapi_url="/api/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=close_jobs_at_the_end,
        exception_handlers={
            HTTPException: error_answer,
            RequestValidationError: error_answer,
        },
    )
    app.needs_token = access is not None and access.token is not None
    app.form_models = FORM_MODELS
    app.state.jobs = jobs
    metrics = open_metrics(jobs)
    app.add_middleware(
        Guard,
        access=access,
        max_bytes=max_bytes,
        count_answer=None if metrics is None else metrics.count_answer,
    )

    takes_photos = access is None or access.token is not None
    # `SceneWork` has a method that lists the bases, the networks for a photo's geometry. Another
    # function as `work` has none; clients can then only choose AUTO.
    list_bases = getattr(work, "bases", lambda: [AUTO])
    # Only a person at this machine may have something installed on it, nobody behind a proxy and no
    # client with a token of its own.
    better_depth = None
    is_private = (
        access is not None and access.local and access.public == LOCAL_ONLY and not access.clients
    )
    if takes_photos and is_private:
        better_depth = BetterDepth()
    base_name = work.base.name if isinstance(work, SceneWork) else None
    public_path = "" if access is None else access.public.path
    rates = RateLimits(() if access is None else access.clients)
    handlers = SceneHandlers(
        jobs, list_bases, takes_photos, max_bytes, public_path, base_name, rates, better_depth
    )
    links = SceneLinks(None if access is None else access.token)
    public_origin = None if access is None else access.public.origin
    add_scene_routes(app, handlers)
    add_link_routes(app, SharedScenes(handlers, links, public_origin))
    add_status_routes(app, handlers, metrics)
    add_page_routes(app, handlers)
    return app


def add_scene_routes(app: FastAPI, handlers: SceneHandlers) -> None:
    """Add the HTTP interface to an app: the routes below /api/v1/scenes."""
    one_scene = SCENES_PATH + "/{id}"

    def add(method: str, path: str, handler: Callable[..., Any], **details: Any) -> None:
        """Add a route, which generated clients call by the name of its handler."""
        app.add_api_route(
            path,
            handler,
            methods=[method],
            operation_id=handler.__name__,
            tags=["scenes"],
            # A client with a token of its own sees and changes its own scenes alone.
            dependencies=[Depends(handlers.check_owner)] if "{id}" in path else [],
            **details,
        )

    add(
        "POST",
        SCENES_PATH,
        handlers.post_photo,
        status_code=202,
        openapi_extra=UPLOAD_FORM,
        responses={**ACCEPTED, **refusals(*ANY_FORM, 415)},
    )
    add(
        "POST",
        one_scene + "/fill",
        handlers.post_fill,
        status_code=202,
        openapi_extra=FILL_FORM,
        responses={**ACCEPTED, **refusals(*ANY_FORM, 404)},
    )
    add(
        "POST",
        one_scene + "/remove",
        handlers.post_removal,
        status_code=202,
        openapi_extra=REMOVAL_FORM,
        responses={**ACCEPTED, **refusals(*ANY_FORM, 404, 415)},
    )
    add("GET", SCENES_PATH, handlers.list_scenes, responses={**PAGE_OF_STATES, **refusals(422)})
    add("GET", one_scene, handlers.get_state, responses={**STATE, **refusals(404)})
    add(
        "DELETE",
        one_scene,
        handlers.delete_scene,
        status_code=204,
        responses={**DELETED, **refusals(404)},
    )
    add(
        "GET",
        one_scene + "/events",
        handlers.get_events,
        response_class=EventSourceResponse,
        responses=refusals(404),
    )
    add(
        "GET",
        one_scene + "/files/{file}",
        handlers.get_file,
        response_class=FileResponse,
        responses={**FILE, **refusals(404, 409, 429, 507)},
    )


def add_link_routes(app: FastAPI, shared: SharedScenes) -> None:
    """Add links to single scenes, and what those see who have one."""
    app.add_api_route(
        SCENES_PATH + "/{id}/link",
        shared.get_link,
        operation_id="get_link",
        tags=["scenes"],
        dependencies=[Depends(shared.handlers.check_owner)],
        responses={**LINK, **refusals(404, 409, 422)},
    )
    page = SHARED_PATH + "/{id}/{key}/"
    app.add_api_route(page, shared.get_page, include_in_schema=False)
    app.add_api_route(page + PREVIEW, shared.get_preview, include_in_schema=False)


def open_metrics(jobs: Jobs) -> Metrics | None:
    """The numbers of a server for Prometheus; None if its package is not installed."""
    try:
        return Metrics(jobs)
    except ModuleNotFoundError:
        return None


def add_status_routes(app: FastAPI, handlers: SceneHandlers, metrics: Metrics | None) -> None:
    """Add what those who watch over the server ask for; all but the numbers also of strangers."""

    async def get_metrics(request: Request) -> Response:
        """Numbers of photos, work and answers, in the text format of Prometheus."""
        # The numbers are sums over all clients.
        if client_of(request.scope) != OPERATOR:
            raise HTTPException(403, "the numbers need the server's own token")
        if metrics is None:
            raise HTTPException(
                404, "metrics: the package is missing: pip install 'spackle-nvs[metrics]'"
            )
        return await run_in_threadpool(metrics.answer)

    app.add_api_route(
        "/metrics",
        get_metrics,
        operation_id="get_metrics",
        tags=["status"],
        response_class=PlainTextResponse,
        responses=refusals(404),
    )
    details: dict[str, Any] = {"tags": ["status"], "openapi_extra": {"security": []}}
    app.add_api_route(
        "/healthz",
        handlers.get_health,
        operation_id="get_health",
        responses={**HEALTH, **refusals(needs_token=False)},
        response_model_exclude_none=True,
        **details,
    )
    app.add_api_route(
        "/readyz",
        handlers.get_readiness,
        operation_id="get_readiness",
        responses={**READY, **refusals(503, needs_token=False)},
        **details,
    )


def add_page_routes(app: FastAPI, handlers: SceneHandlers) -> None:
    """Add the page and its files to an app, and the description of the HTTP interface."""

    async def get_docs(request: Request) -> HTMLResponse:
        """A page that describes the HTTP interface, from its OpenAPI description."""
        template = Template(read_page_file("docs.html").decode(), autoescape=True)
        description = app.openapi()
        content = template.render(
            api=description,
            resolve=functools.partial(resolve, description),
            # How the page's addresses lead back to the root, where its style lies.
            up="../../" if request.url.path.endswith(DOCS_PATH) else "",
        )
        return HTMLResponse(content)

    # These routes serve the page and are no part of the interface for programs.
    app.add_api_route("/page.json", handlers.get_page_state, include_in_schema=False)
    if handlers.better_depth is not None:
        for method, handler in (
            ("GET", handlers.get_better_depth),
            ("POST", handlers.post_better_depth),
        ):
            app.add_api_route("/better-depth", handler, methods=[method], include_in_schema=False)
    for path in ("/docs", DOCS_PATH):
        app.add_api_route(path, get_docs, include_in_schema=False)
    # The last route, because it takes every other path.
    app.mount("/", StaticFiles(packages=[("spackle.web", "page")], html=True))


class SceneHandlers:
    """The functions that answer requests; each method is named after what a client asks for."""

    def __init__(
        self,
        jobs: Jobs,
        list_bases: Callable[[], list[str]],
        takes_photos: bool,
        max_bytes: int,
        public_path: str,
        base_name: str | None,
        rates: RateLimits,
        better_depth: BetterDepth | None = None,
    ) -> None:
        """Prepare to answer requests.

        Args:
            jobs: the photos and scenes of the server.
            list_bases: returns the names of the bases, the networks for a photo's geometry, that a
                client may choose.
            takes_photos: whether a client may send photos; otherwise the page only shows scenes.
            max_bytes: size limit of an upload.
            public_path: the part of an address's path that a proxy takes away, such as "/photos".
            base_name: the name of the base of photos whose clients choose none, if known.
            rates: limits how many photos a client may send.
            better_depth: fetches a better network when the page asks for it; None if nobody may.
        """
        self.better_depth = better_depth
        self.jobs = jobs
        self.list_bases = list_bases
        self.takes_photos = takes_photos
        self.max_bytes = max_bytes
        self.public_path = public_path
        self.base_name = base_name
        self.rates = rates
        # Clients and Idempotency-Keys of requests that still arrive.
        self.keys_in_progress: set[tuple[str, str]] = set()
        # A photo that waits for its decoder takes no thread from other requests.
        self.decoding = asyncio.Semaphore(DECODER_COUNT)

    async def post_photo(
        self, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> SceneState:
        """Send a photo. The photo is queued; if the queue is full, the answer is 429."""
        bases = self.list_bases()
        accept = functools.partial(accept_photo, bases=bases)
        return await self._accept(request, response, idempotency_key, accept)

    async def post_fill(
        self, id: str, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> SceneState:
        """Fill a finished scene where views show holes; the result is another scene.

        Its file report.json says how many Gaussians were added.
        """
        accept = functools.partial(accept_fill, parent=self.find_finished(id))
        return await self._accept(request, response, idempotency_key, accept)

    async def post_removal(
        self, id: str, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> SceneState:
        """Take the thing that a mask marks out of a finished scene, and fill what it hid.

        The result is another scene. Its file removed.ply is the scene without the thing, before
        anything was filled; report.json says how many Gaussians were removed and added.
        """
        accept = functools.partial(accept_removal, parent=self.find_finished(id))
        return await self._accept(request, response, idempotency_key, accept)

    async def _accept(
        self,
        request: Request,
        response: Response,
        idempotency_key: str | None,
        accept: Callable[..., Job],
    ) -> SceneState:
        """Receive a form, have `accept` check and queue it, and answer with the job's state.

        A request that repeats an earlier one with the same key is answered with the earlier job.

        Args:
            request: the request, with the form.
            response: gets the address of the job's state.
            idempotency_key: what the client calls its request, or None.
            accept: takes the form, a folder for its files, `jobs`, and a `Submission`.

        Raises:
            HTTPException: 429 if the queue is full or the client has sent too many photos, 408 for
                a form that comes too slowly, 409 if a request with the same key still arrives, 422
                if the key belongs to another request, or for a `callback_url` that is none.
        """
        if idempotency_key is None:
            job = await self._receive(request, accept, None)
        else:
            key = RequestKey(idempotency_key, request.url.path.removeprefix(self._root(request)))
            job = await self._receive_once(request, accept, key)

        # A proxy may have taken another part of the path away.
        path = f"{self.public_path}{self._root(request)}{SCENES_PATH}/{job.id}"
        response.headers["Location"] = path
        return self.state_of(job)

    async def _receive_once(
        self, request: Request, accept: Callable[..., Job], key: RequestKey
    ) -> Job:
        """The job of a request with a key: that of an earlier one, or a new one."""
        # Two clients may choose the same key.
        client = client_of(request.scope)
        client_and_key = (client, key.idempotency_key)
        if client_and_key in self.keys_in_progress:
            raise HTTPException(409, "a request with this Idempotency-Key still arrives")
        former = self.jobs.with_key(key.idempotency_key, client)
        if former is None:
            self.keys_in_progress.add(client_and_key)
            try:
                return await self._receive(request, accept, key)
            finally:
                self.keys_in_progress.discard(client_and_key)
        if former.request_path != key.request_path:
            raise HTTPException(422, "Idempotency-Key: it belongs to another request")
        return former

    async def _receive(
        self, request: Request, accept: Callable[..., Job], key: RequestKey | None
    ) -> Job:
        """The new job of a form; see `_accept`."""
        client = client_of(request.scope)
        # The place is reserved first, so that a refused photo is not even received.
        check_form_type(request)
        # Folders are made and deleted in a thread: a busy disk must hold up nobody else.
        with self.rates.count_photo(client), as_no_space():
            async with contextmanager_in_threadpool(self.jobs.reserve_place()) as upload_folder:
                return await self._receive_into(upload_folder, request, accept, client, key)

    async def _receive_into(
        self,
        upload_folder: Path,
        request: Request,
        accept: Callable[..., Job],
        client: str,
        key: RequestKey | None,
    ) -> Job:
        """The new job of a form that comes from a client into an empty folder; see `_accept`."""
        try:
            # Two files, such as the photo and its depth map. Two text fields: the options, and
            # the address to call at the end.
            reading = request.form(max_files=2, max_fields=2)
            form = await asyncio.wait_for(reading, MAX_UPLOAD_S)
        except asyncio.TimeoutError:
            raise HTTPException(408, "the photo arrived too slowly") from None
        try:
            # Every form may have this field.
            callback_url = self.jobs.callbacks.check(form.get("callback_url"))
            submission = Submission(client, key, callback_url)
            async with self.decoding:
                return await run_in_threadpool(accept, form, upload_folder, self.jobs, submission)
        finally:
            await form.close()

    @staticmethod
    def _root(request: Request) -> str:
        """The root path, which holds the token, or the place where another app has mounted this."""
        root: str = request.scope["root_path"]
        return root

    def state_of(self, job: Job) -> SceneState:
        """The state of a job as clients see it, with its place and the files that exist now."""
        state = state_with_files(job, self.jobs.place_of(job))
        return state.model_copy(update={"making": self.jobs.files_in_work(job.id)})

    async def list_scenes(
        self, request: Request, limit: PageSize = DEFAULT_PAGE_SIZE, after: PageMark = None
    ) -> ScenePage:
        """The states of all photos of the client, the newest first, in pages."""
        # Somebody who may only look at a scene must know its id.
        if not self.takes_photos:
            raise HTTPException(401, "this page lists no scenes: it was opened without a token")
        mark = None
        if after is not None:
            created, _, id = after.partition("-")
            mark = (float(created), id)
        # One job more than asked for shows whether another page follows.
        jobs = self.jobs.page(limit + 1, mark, client_of(request.scope))
        scenes = [self.state_of(job) for job in jobs[:limit]]
        next_mark = None
        if len(jobs) > limit:
            next_mark = "{!r}-{}".format(*age_key(jobs[limit - 1]))
        return ScenePage(scenes=scenes, next=next_mark)

    async def get_state(self, id: str) -> SceneState:
        """The state of a photo and its files."""
        return self.state_of(self.find_job(id))

    async def delete_scene(self, id: str) -> None:
        """Delete a photo and its scene, and end work on it."""
        job = self.find_job(id)
        await run_in_threadpool(self.jobs.remove, job.id)

    async def get_events(self, id: str) -> AsyncIterator[SceneState]:
        """Server-sent events: the state, now and at each change, until the work has ended."""
        last_sent: Job | None = None
        last_place: int | None = None
        while last_sent is None or last_sent.ended is None:
            job = self.jobs.by_id.get(id)
            if job is None:
                # The answer has begun, so a status of 404 is no longer possible. A time of the end,
                # here 0, tells the client that nothing more follows.
                yield SceneState(
                    id=id, name="", state="failed", error="there is no such scene", ended=0
                )
                return
            # A change replaces the job by another object.
            place = self.jobs.place_of(job)
            if job is not last_sent or place != last_place:
                last_sent = job
                last_place = place
                yield state_with_files(job, place)
            await asyncio.sleep(POLL_S)

    async def get_file(
        self, id: str, file: FileName | PagePart, request: Request, caption: PageCaption = ""
    ) -> Response:
        """A file of a finished scene; a file that does not exist yet is made on demand."""
        job = self.find_job(id)
        path = await self.make_file(request, job, file)
        name = PurePosixPath(job.name).stem + path.suffix
        if file == PAGE_FILE and caption:
            page = await run_in_threadpool(path.read_bytes)
            attachment = FileResponse(path, filename=name).headers["Content-Disposition"]
            return HTMLResponse(
                with_tags(page, caption), headers={"Content-Disposition": attachment}
            )
        return FileResponse(path, filename=name, media_type=MEDIA_TYPES.get(path.suffix, OCTETS))

    async def make_file(self, request: Request, job: Job, file: str) -> Path:
        """Where a file of a finished scene lies; it is made first if it does not exist yet.

        HTTPException 409 if the scene is not done, 404 if the file cannot be made.
        """
        path = own_file(job, file)
        if not path.is_file():
            if job.state != "done":
                raise HTTPException(409, job.error or "this scene is not done yet")
            # What the page draws was written with the scene, so it cannot be made now.
            if file in get_args(PagePart):
                raise HTTPException(404, "this scene has no such file")
            await self._wait_for_file(request, job, file)
        return path

    async def _wait_for_file(self, request: Request, job: Job, file: str) -> None:
        """Wait until a file of a finished scene is made, or the client has gone.

        Raises:
            HTTPException: the file cannot be made: 404 for what the scene cannot give, 429 if too
                many files wait, 507 if the disk is full.
            ClientDisconnect: the client has gone.
        """
        is_video = file in (*get_args(Video), *get_args(SharedVideo))
        with self.jobs.wait_for_file(job, file, is_video=is_video) as file_order:
            made = asyncio.wrap_future(file_order.order.outcome)
            left = asyncio.ensure_future(wait_for_disconnect(request))
            ends: set[asyncio.Future[Any]] = {made, left}
            try:
                await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
                if not made.done():
                    raise ClientDisconnect
            finally:
                left.cancel()
            failure = made.result()
        if failure is not None:
            named = failure._replace(line=error_line(file, failure))
            raise refusal_of(named, 404 if failure.kind == "input" else 500)

    async def get_page_state(self) -> dict[str, object]:
        """What the page may send: kinds of files, size limit, and networks to choose from.

        {"upload": null} if it may send nothing.
        """
        if not self.takes_photos:
            return {"upload": None}
        return {
            "upload": {
                "suffixes": PHOTO_SUFFIXES,
                "max_bytes": self.max_bytes,
                "bases": self.list_bases(),
                "better_depth": self.better_depth and self.better_depth.offer(),
            }
        }

    async def get_better_depth(self) -> FetchState:
        """How far the download of a better network's weights is."""
        assert self.better_depth is not None  # else there is no such route
        return self.better_depth.state()

    async def post_better_depth(self) -> FetchState:
        """Begin to fetch a better network's weights onto this machine."""
        assert self.better_depth is not None  # else there is no such route
        return self.better_depth.start()

    async def get_health(self, request: Request) -> Health:
        """Whether the server runs; with the token also its version and its base."""
        if request.scope.get(STRANGER):
            return Health()
        return Health(version=spackle.__version__, base=self.base_name)

    async def get_readiness(self) -> Readiness:
        """Whether the server can complete photos: a worker runs, and the disk has space."""
        try:
            await run_in_threadpool(self.jobs.check_ready)
        except InputError as error:
            raise HTTPException(503, str(error)) from error
        return Readiness()

    async def check_owner(self, id: str, request: Request) -> None:
        """HTTPException 404 if the scene with an id belongs to another client."""
        job = self.jobs.by_id.get(id)
        if job is not None and not may_use(client_of(request.scope), job.client):
            raise HTTPException(404, "there is no such scene")

    def find_finished(self, id: str) -> Job:
        """The job with an id; HTTPException 404 if there is none, 409 if it has no scene yet."""
        job = self.find_job(id)
        if job.state != "done":
            raise HTTPException(409, job.error or "this scene is not done yet")
        return job

    def find_job(self, id: str) -> Job:
        """The job with an id; HTTPException 404 if there is none."""
        job = self.jobs.by_id.get(id)
        if job is None:
            raise HTTPException(404, "there is no such scene")
        return job


class SharedScenes:
    """What somebody sees who has no token but the link of one scene."""

    def __init__(
        self, handlers: SceneHandlers, links: SceneLinks, public_origin: str | None
    ) -> None:
        """Share scenes of the server that `handlers` serve.

        Args:
            handlers: they know the scenes.
            links: makes and checks the links.
            public_origin: how a browser calls the server behind its proxy, such as
                "https://example.com"; None without a proxy.
        """
        self.handlers = handlers
        self.links = links
        self.public_origin = public_origin

    async def get_link(self, id: str, request: Request, caption: PageCaption = "") -> SceneLink:
        """The link of a finished scene: it shows the scene to whoever has it, and nothing else."""
        self.handlers.find_finished(id)
        path = self.links.path_of(id, caption)
        return SceneLink(path=None if path is None else f"{self._root(request)}{path}")

    async def get_page(
        self, id: str, key: str, request: Request, caption: PageCaption = ""
    ) -> HTMLResponse:
        """The page of one scene, as `scene.html` is, with a caption."""
        job = self._find(id, key, caption)
        path = await self.handlers.make_file(request, job, PAGE_FILE)
        page = await run_in_threadpool(path.read_bytes)

        # Programs that show previews of links fetch the picture by its full address.
        host = request.headers["host"]
        origin = self.public_origin or f"{request.url.scheme}://{host}"
        preview = f"{origin}{self._root(request)}{self.links.path_of(id)}{PREVIEW}"
        return HTMLResponse(with_tags(page, caption, preview), headers=SHARED_HEADERS)

    async def get_preview(self, id: str, key: str) -> FileResponse:
        """The small photo of a scene, for previews of its link."""
        job = self._find(id, key, "")
        return FileResponse(own_file(job, PREVIEW), media_type=MEDIA_TYPES[".jpg"])

    def _root(self, request: Request) -> str:
        """What stands before the paths of links in an address: the part that a proxy takes away,
        and the place where another app has mounted this one.
        """
        return f"{self.handlers.public_path}{outer_root(request.scope)}"

    def _find(self, id: str, key: str, caption: str) -> Job:
        """The finished job that a link leads to; HTTPException 404 for a link that is none."""
        if not self.links.is_genuine(id, key, caption):
            raise HTTPException(404, "there is no such scene")
        return self.handlers.find_finished(id)


async def wait_for_disconnect(request: Request) -> None:
    """Return when the client of a request has gone; the body of the request is passed over."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def path_of_file(job: Job, file: str) -> Path:
    """Where a file of a job lies; the preview of the photo exists before the results do."""
    folder = job.folder if file == PREVIEW else job.results
    return folder / file


def own_file(job: Job, file: str) -> Path:
    """Where a file of a job lies, if it is no link; HTTPException 404 for one.

    Whoever can put a link there might lead clients to any file of this machine.
    """
    path = path_of_file(job, file)
    if path.is_symlink() or path.parent.is_symlink():
        raise HTTPException(404, "this scene has no such file")
    return path


def state_with_files(job: Job, place: int | None = None) -> SceneState:
    """The state of a job as clients see it, with its place and the files that exist now."""
    # One look at the folder costs less than one at each file, and clients ask for states often.
    existing: set[str] = set()
    with contextlib.suppress(OSError):  # there are no results before the work begins
        existing.update(os.listdir(job.results))
    if path_of_file(job, PREVIEW).is_file():
        existing.add(PREVIEW)
    files = [file for file in LISTED_FILES if file in existing]
    return job.model_copy(update={"files": files, "place": place})


def check_form_type(request: Request) -> None:
    """HTTPException 400 for a form that is not multipart or whose texts are not UTF-8.

    Some of Python's codecs take minutes for a megabyte, and forms of the other kind are unbounded.
    """
    media_type, details = parse_options_header(request.headers.get("content-type"))
    charset = details.get(b"charset", b"utf-8").lower()
    if media_type != b"multipart/form-data" or charset not in (b"utf-8", b"utf8"):
        raise HTTPException(400, "send a form as multipart/form-data, with texts in UTF-8")


async def error_answer(request: Request, error: Any) -> JSONResponse:
    """The answer to a refused request: {"error": the reason in one line}.

    Args:
        request: the request, which FastAPI passes to every such function.
        error: an HTTPException, or FastAPI's error for a path or parameter that does not exist.
    """
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)
    # A bad part of the path is the name of something that does not exist.
    problem = error.errors()[0]
    place, *name = problem["loc"]
    if place == "path":
        return JSONResponse({"error": "there is nothing with that name"}, 404)
    line = printable_line(f"{'.'.join(map(str, name))}: {problem['msg'].lower()}")
    return JSONResponse({"error": line}, 422)


def make_server(app: FastAPI) -> uvicorn.Server:
    """A server whose `run(sockets=[listener])` serves an app until Ctrl-C or SIGTERM.

    The app's processes end with it.
    """
    config = uvicorn.Config(
        app,
        http=PatientProtocol,  # HTTP, with a limit on how long a connection may be silent
        ws="none",  # no WebSocket
        log_config=None,  # leaves the logging of this program as it is
        log_level="critical",  # the app logs requests and errors itself
        server_header=False,  # strangers learn no versions
        proxy_headers=False,  # anybody could claim another address
        timeout_graceful_shutdown=1,  # seconds for clients that still watch a photo
    )
    return uvicorn.Server(config)


class PatientProtocol(H11Protocol):
    """uvicorn's connection to one client, which ends if the client stays silent.

    A client may take `MAX_HEAD_S` seconds for it. Otherwise silent clients could take up all
    connections. If there are too many, the one that has been idle for longest makes room: it never
    keeps anybody else out.
    """

    # Connections without a request that is being answered; the one that is idle for longest first.
    idle: ClassVar[dict[PatientProtocol, None]] = {}

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Note a new connection, make room for it, and begin to watch it."""
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS:
            # Another server of this process has other connections.
            idle = [each for each in self.idle if each in self.connections]
            (idle[0] if idle else self).transport.abort()
        self.idle[self] = None
        self._end_if_silent(BUSY)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self.idle.pop(self, None)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Read what has come; a connection with a request is not idle."""
        super().handle_events()
        if self.cycle is not None and not self.cycle.response_complete:
            self.idle.pop(self, None)

    def on_response_complete(self) -> None:
        """Note that the connection is idle again."""
        self.idle[self] = None
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, with the headers of every answer; the connection ends."""
        body = json.dumps({"error": "this is no HTTP request"}).encode()
        headers = {
            "Content-Type": "application/json",
            "Content-Length": str(len(body)),
            "Connection": "close",
            **SECURITY_HEADERS,
        }
        lines = [f"{name}: {value}" for name, value in headers.items()]
        head = "\r\n".join(["HTTP/1.1 400 Bad Request", *lines, "", ""])
        self.transport.write(head.encode() + body)
        self.transport.close()

    def _end_if_silent(self, idle_after: object) -> None:
        """Close the connection if it was idle since the last call; otherwise check again later.

        `MAX_HEAD_S` seconds lie between two calls.

        Args:
            idle_after: what the last call saw. BUSY: a request was not answered yet. A request: the
                connection was idle after the answer to it. None: no request had come yet.
        """
        latest_request = self.cycle  # uvicorn's name for a request with its answer
        is_idle = latest_request is None or latest_request.response_complete
        is_silent = is_idle and latest_request is idle_after
        if self.transport.is_closing() or is_silent:
            # Not `close`, which would first wait until the client has read what was sent.
            self.transport.abort()
        else:
            now_idle_after = latest_request if is_idle else BUSY
            self.loop.call_later(MAX_HEAD_S, self._end_if_silent, now_idle_after)
