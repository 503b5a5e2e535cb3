"""Jobs: worker processes turn photos into scenes; the folder of jobs outlives the server.

Three lanes of processes do the work: one decodes what is uploaded, one makes scenes, and two make
files of finished scenes when somebody asks for them. All that is ordered for a scene ends with it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from fastapi import HTTPException
from pydantic import BaseModel, Field

from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.lanes import Lane, Order
from spackle.runtime.progress import StageProgress
from spackle.runtime.task_process import (
    CANCELLED,
    TaskEvent,
    TaskFailure,
    TaskFunction,
    TaskLimits,
    import_ahead,
    machine_fault,
    machine_memory,
)
from spackle.web.callbacks import CallbackSender
from spackle.web.clients import OPERATOR, may_use
from spackle.web.decoding import DecodingTask, decode_upload
from spackle.web.failures import full_queue, without_folders

LOG = logging.getLogger("spackle.web")
RECORD_FILE = "job.json"  # stores the state of a job, in the folder of the job
UPLOAD_PREFIX = ".new-"  # begins the names of folders of incomplete uploads
DELETED_PREFIX = ".old-"  # begins the names of folders that are being deleted
MIN_FREE_BYTES = 200_000_000  # that a photo with its results may take
# The task of a process that prepares for its first photo, and the stage of photos that wait for it.
WARM_UP = "warm-up"
TIDY_INTERVAL_S = 60.0  # seconds between two searches for results that are too old
RETRY_S = 30.0  # seconds after which a photo is tried again if the disk was full
# A worker that dies may have been killed by somebody else. The photo is blamed at the second time.
MAX_ATTEMPTS = 2

DECODER_COUNT = 2  # photos that are decoded at a time: a large one takes a gigabyte of memory
# A photo of 100 megapixels takes a fifth of this time, and a third of this memory. The time by the
# clock is for a decoder that waits for something.
DECODING_LIMITS = TaskLimits(seconds=120, cpu_seconds=20, memory_bytes=4_000_000_000)
# So much of the machine's memory the work on a scene, or on a file of it, may take; the server and
# the system live on with what is left.
SCENE_MEMORY_SHARE = 0.9
# Seconds after which a file is given up that nobody waits for any more. A proxy that has lost its
# patience, or a client that has lost its connection, asks again at once.
ABANDONED_AFTER_S = 5.0


class RetentionLimits(NamedTuple):
    """Limits of the folder, of which the oldest finished jobs are removed first, and of a job."""

    seconds: float = 7 * 86400.0  # since a job ended: a week
    size: float = 20e9  # bytes
    waiting: int = 32  # jobs in the queue
    work_s: float = 3600.0  # that the work on a photo, or on a file of its scene, may take


JobState = Literal["queued", "running", "done", "failed"]
EditKind = Literal["fill", "remove"]


class WorkTimes(NamedTuple):
    """How many jobs have ended since the start of the server, and the seconds of work on them."""

    jobs: int = 0
    seconds: float = 0.0


class Edit(NamedTuple):
    """What is to be done to a scene, which becomes another scene."""

    kind: EditKind
    parent: str  # the id of the scene
    cameras: list[dict[str, Any]]  # the views to fill, or the one in which a mask was drawn
    mask: str | None = None  # the mask's file, a name in the job's folder


class RequestKey(NamedTuple):
    """What a client has called a request, so that it can repeat it without another scene."""

    idempotency_key: str
    request_path: str


class Submission(NamedTuple):
    """Who has sent a photo or edit, and what else the client has said about its request."""

    client: str = OPERATOR  # the client's name
    key: RequestKey | None = None
    callback_url: str | None = None  # an address that `callbacks` accepts, which is told the end


OWN_SUBMISSION = Submission()  # of whoever runs the server


class FileProgress(BaseModel):
    """A file of a finished scene that is being made, because somebody has asked for it."""

    file: str
    place: int | None = Field(
        default=None, description="Number of files that come before; null: it is being made."
    )
    share: float | None = Field(default=None, description="Fraction that is done, 0 to 1.")


class SceneState(BaseModel):
    """The state of a photo, as clients see it."""

    id: str
    name: str
    state: JobState = "queued"
    stage: str | None = Field(default=None, description="The stage in progress.")
    share: float | None = Field(
        default=None, description="Fraction of the stage that is done, 0 to 1, if known."
    )
    line: str | None = Field(default=None, description="The latest log message.")
    error: str | None = Field(default=None, description="Why it failed, in a line.")
    files: list[str] = Field(
        default=[], description="Existing files; a finished scene can make more."
    )
    making: list[FileProgress] = Field(
        default=[], description="Files that are being made, because somebody has asked for them."
    )
    place: int | None = Field(
        default=None,
        description="Number of photos that come before, while it is queued; 0: it is the next.",
    )
    created: float = Field(default_factory=time.time, description="Seconds since 1970.")
    ended: float | None = None
    parent: str | None = Field(
        default=None, description="The scene from which this one was made by an edit."
    )
    edit: EditKind | None = Field(default=None, description="What was done to the parent.")


class Job(SceneState):
    """A photo's state, and fields that only the server uses.

    `RECORD_FILE` stores every field except the folder.
    """

    source: str  # the photo: a name in the job's folder, or an absolute path
    depth: str | None = None  # its depth map, in the same way
    options: dict[str, Any] = {}  # what the client has set
    # Of an edit: the views to fill, or the view in which the mask was drawn, as JSON; the mask.
    cameras: list[dict[str, Any]] = []
    mask: str | None = None
    client: str = OPERATOR  # the name of the client who has sent it
    callback_url: str | None = None  # is told the state at the end; None afterwards
    # What the client called its request, and where it sent it, so that it can repeat the request.
    idempotency_key: str | None = None
    request_path: str | None = None
    attempts: int = 0  # how often a worker has begun with it
    folder: Path = Field(default=Path(), exclude=True)

    @property
    def results(self) -> Path:
        """The folder of the scene's files."""
        return self.folder / "results"

    def save(self) -> None:
        """Write the record of the job into its folder; InputError if the disk is full."""
        write_json(self.model_dump(mode="json"), self.folder / RECORD_FILE)


class FileOrder:
    """A file of a finished scene that is being made, and how many clients wait for it."""

    def __init__(self, order: Order, file: str) -> None:
        """Nobody waits yet for the file of this name, which `order` makes."""
        self.order = order
        self.file = file
        self.share: float | None = None  # that is done, 0..1
        self.waiting_clients = 0

    def note_event(self, event: TaskEvent) -> None:
        """Note the progress that the process reports."""
        if "line" not in event:
            self.share = StageProgress(**event).share


class Jobs:
    """The jobs in a folder, by id, and the processes that work on them.

    Jobs in `by_id` never change; a change replaces a job by a new one, so that readers need no
    lock. What is in the record of a job on the disk is what a later server begins with; a job has
    ended when its record says so, and not before.
    """

    def __init__(
        self,
        folder: Path,
        work: TaskFunction,
        workers: int,
        keep: RetentionLimits,
        callbacks: CallbackSender | None = None,
    ) -> None:
        """Open a folder of jobs, start the processes, and go on with unfinished jobs.

        Args:
            folder: holds a folder for each job; created if it is missing.
            work: takes (job, file) in a worker process, and reports {stage, done, total} or {line}.
                If `file` is None, it makes a scene of the photo; else it adds this file to a
                finished scene.
            workers: number of processes that make scenes; each has a GPU of its own if there are
                enough.
            keep: limits of the folder.
            callbacks: tells clients the end of their jobs; None: nobody is told.

        Raises:
            InputError: another server uses the folder, or it cannot be used.
        """
        self.folder = folder
        self.limits = keep
        self.callbacks = CallbackSender((), {}) if callbacks is None else callbacks
        self._folder_lock = contextlib.ExitStack()
        self._folder_lock.enter_context(results_folder(folder, locked=True))

        self.by_id: dict[str, Job] = {}
        self._lock = threading.RLock()  # of `by_id`, and of the orders
        self._is_closed = threading.Event()
        self._is_warming_up = False
        self._work = work
        self.work_times = {"done": WorkTimes(), "failed": WorkTimes()}

        import_ahead("spackle.web.work")
        # A process that makes scenes keeps the network that it has loaded. A single one, and those
        # of the other lanes, use torch's default GPU.
        gpu_numbers = range(workers) if workers > 1 else range(0)
        self._scenes = Lane(work, workers, gpu_numbers=gpu_numbers)
        self._decoders = Lane(decode_upload, DECODER_COUNT, is_kept=False)
        # A video may take many minutes, and must not hold up the scene in another format.
        self._videos = Lane(work, 1, is_kept=False)
        self._small_files = Lane(work, 1, is_kept=False)
        self._lanes = (self._scenes, self._decoders, self._videos, self._small_files)
        self._scene_orders: dict[str, Order] = {}  # by the id of a job that waits or runs
        self._file_orders: dict[tuple[str, str], FileOrder] = {}  # by id and name of the file

        # A process takes seconds to start: it does so while the first photo is uploaded.
        self._scenes.prepare()
        self._resume_jobs()
        threading.Thread(target=self._tidy_until_closed, daemon=True).start()

    def _resume_jobs(self) -> None:
        """Queue the unfinished jobs of an earlier server again, and delete incomplete uploads."""
        for folder in self.folder.iterdir():
            # A link may lead to anything, and is not ours.
            if folder.is_symlink():
                continue
            if folder.name.startswith((UPLOAD_PREFIX, DELETED_PREFIX)):
                shutil.rmtree(folder, ignore_errors=True)
            # A folder without a readable record is no job, and is left alone.
            with contextlib.suppress(OSError, ValueError):
                job = Job.model_validate_json((folder / RECORD_FILE).read_bytes())
                if job.id == folder.name:
                    self.by_id[job.id] = job.model_copy(update={"folder": folder})

        # The photo that came first is completed first.
        for job in sorted(self.by_id.values(), key=lambda job: job.created):
            if job.ended is None:
                self._enqueue(job.id)

    def _enqueue(self, id: str, line: str | None = None) -> None:
        """Let a job wait for a process; `line` tells clients why it waits again."""
        with self._lock:
            if id not in self.by_id or self._is_closed.is_set():
                return
            stage = WARM_UP if self._is_warming_up else None
            self._change(id, state="queued", stage=stage, share=None, line=line)
            self._scene_orders[id] = self._scenes.submit(id, lambda order: self._run(order))

    def place_of(self, job: Job) -> int | None:
        """The number of jobs that come before one that waits; None for one that does not wait."""
        order = self._scene_orders.get(job.id)
        return None if order is None else self._scenes.place_of(order)

    def page(self, count: int, after: tuple[float, str] | None, client: str) -> list[Job]:
        """Up to `count` jobs that a client may see, the newest first.

        Args:
            count: the number of jobs.
            after: time of creation and id of the last job of the page before; None: the first page.
            client: the name of the client.
        """
        visible_jobs = [job for job in list(self.by_id.values()) if may_use(client, job.client)]
        jobs = sorted(visible_jobs, key=age_key, reverse=True)
        if after is not None:
            # Not the position of that job, which may be deleted by now.
            jobs = [job for job in jobs if age_key(job) < after]
        return jobs[:count]

    def with_key(self, key: str, client: str) -> Job | None:
        """The job of the request that a client has named by this key; None if there is none."""
        for job in list(self.by_id.values()):
            if job.idempotency_key == key and job.client == client:
                return job
        return None

    def check_ready(self) -> None:
        """InputError if no photo can be completed now, because the disk is full, for example."""
        if self._is_closed.is_set():
            raise InputError("the server ends")
        if not self._scenes.has_process:
            raise InputError("the first worker process has not started yet")
        with as_input_error("the folder of scenes", "cannot be used: {reason}", OSError):
            free_bytes = shutil.disk_usage(self.folder).free
        if free_bytes < MIN_FREE_BYTES:
            raise InputError(
                f"the disk of the folder of scenes is full: {free_bytes / 1e6:.0f} MB are left"
            )

    def start_callbacks(self, describe: Callable[[Job], SceneState]) -> None:
        """Tell clients the end of their jobs from now on, also of jobs that have ended before.

        Args:
            describe: returns the state of a job as clients see it.
        """

        def state_of(id: str) -> bytes | None:
            """The state of the job with an id, as JSON; None if it was deleted."""
            job = self.by_id.get(id)
            if job is None:
                return None
            state = describe(job)
            return state.model_dump_json(include=set(SceneState.model_fields)).encode()

        self.callbacks.start(state_of, self._forget_callback)
        for job in list(self.by_id.values()):
            if job.ended is not None and job.callback_url is not None:
                self.callbacks.schedule(job.id, job.callback_url, job.client)

    def _forget_callback(self, id: str) -> None:
        """Note that nobody is to be told the end of a job any more."""
        self._change(id, callback_url=None)
        job = self.by_id.get(id)
        if job is not None:
            # If the disk is full, or the job has just been deleted, there is nothing to be done.
            with contextlib.suppress(InputError, OSError):
                job.save()

    def warm_up(self) -> None:
        """Have a process prepare for its first photo, if its work can do that; returns at once.

        The work is then called with the task `WARM_UP`. Photos that come meanwhile wait, and their
        state says so.
        """
        if getattr(self._work, "prepares_for_photos", False):
            self._is_warming_up = True
            self._scenes.submit("", self._warm_up)

    def _warm_up(self, order: Order) -> TaskFailure | None:
        """Do the task `WARM_UP` in a process."""
        try:
            # What goes wrong here goes wrong again with the first photo, whose sender is told.
            failure = order.do(WARM_UP, ignore_event)
            LOG.debug("prepared for the first photo: %s", failure or "done")
            return failure
        finally:
            self._is_warming_up = False

    def _change(self, id: str, **values: object) -> None:
        """Set fields of the state of a job, unless `remove` has deleted the job."""
        with self._lock:
            if id in self.by_id:
                self.by_id[id] = self.by_id[id].model_copy(update=values)

    @contextlib.contextmanager
    def reserve_place(self) -> Iterator[Path]:
        """Reserve a place in the queue, and yield a folder that receives the photo.

        The folder is deleted at the end of the block, unless `add` has made it the folder of a job.
        HTTPException 429 if the queue is full.
        """
        folder = self.folder / f"{UPLOAD_PREFIX}{secrets.token_hex(8)}"
        with self._lock:
            upload_count = len(list(self.folder.glob(f"{UPLOAD_PREFIX}*")))
            queued_count = sum(job.state == "queued" for job in self.by_id.values())
            if upload_count + queued_count >= self.limits.waiting:
                raise full_queue("photos")
            folder.mkdir()
        try:
            yield folder
        finally:
            # An accepted photo is no longer here: `add` has renamed its folder.
            shutil.rmtree(folder, ignore_errors=True)

    def add(
        self,
        folder: Path,
        name: str,
        source: str,
        depth: str | None,
        options: dict[str, Any],
        edit: Edit | None = None,
        submission: Submission = OWN_SUBMISSION,
    ) -> Job:
        """Add a job for a photo or for an edit of a scene, and queue it; returns the job.

        Args:
            folder: a folder that `reserve_place` has yielded; it becomes the folder of the job.
            name: what messages and the page call the photo.
            source: the photo's file, a name in the folder or an absolute path.
            depth: its depth map, in the same way; None if there is none.
            options: what the client has set.
            edit: what is to be done to the scene in the file `source`; None for a photo.
            submission: who has sent it.
        """
        id = folder.name.removeprefix(UPLOAD_PREFIX)
        job = Job(
            id=id,
            name=name,
            source=source,
            depth=depth,
            options=options,
            callback_url=submission.callback_url,
            client=submission.client,
            folder=folder,
        )
        if edit is not None:
            # A job has the parts of its edit as fields of its own; the kind is the field `edit`.
            parts = edit._asdict()
            kind = parts.pop("kind")
            job = job.model_copy(update={"edit": kind, **parts})
        if submission.key is not None:
            job = job.model_copy(update=submission.key._asdict())
        job.save()
        # `reserve_place` counts folders and jobs, so the two change together.
        with self._lock:
            job_folder = folder.rename(self.folder / id)
            job = job.model_copy(update={"folder": job_folder})
            self.by_id[id] = job
            self._enqueue(id)
            return self.by_id[id]

    def decode(self, task: DecodingTask) -> TaskFailure | None:
        """Decode what a client has sent in a process of its own, and wait; None: it is whole."""
        order = self._decoders.submit(
            "", lambda order: order.do(task, ignore_event, DECODING_LIMITS)
        )
        return order.outcome.result()

    @contextlib.contextmanager
    def wait_for_file(self, job: Job, file: str, *, is_video: bool) -> Iterator[FileOrder]:
        """Have a file added to a finished scene; the block waits for `order.outcome`.

        Who asks for a file that is being made already waits for the same one. A file is given up
        when the last client has left its block, unless another one comes at once.

        Args:
            job: of the scene.
            file: the name of the file, such as "scene.glb".
            is_video: whether it may take minutes, so that it must not hold up other files.

        Raises:
            HTTPException: 429 if too many files wait.
        """
        key = (job.id, file)
        with self._lock:
            file_order = self._file_orders.get(key)
            if file_order is None:
                file_order = self._order_file(job, file, is_video)
            file_order.waiting_clients += 1
        try:
            yield file_order
        finally:
            with self._lock:
                file_order.waiting_clients -= 1
                if not file_order.waiting_clients and not file_order.order.outcome.done():
                    call_later(ABANDONED_AFTER_S, self._give_up_if_unwanted, file_order)

    def _order_file(self, job: Job, file: str, is_video: bool) -> FileOrder:
        """Order a file that nobody has ordered yet; the caller holds the lock."""
        lane = self._videos if is_video else self._small_files
        if lane.waiting_count >= self.limits.waiting:
            raise full_queue("files")
        if job.id not in self.by_id:  # it has been deleted in this moment
            raise HTTPException(404, "there is no such scene")
        limits = scene_limits(self.limits.work_s)

        def add_file(order: Order) -> TaskFailure | None:
            return order.do((job, file), lambda event: file_order.note_event(event), limits)

        # It cannot begin, and report, before `file_order` exists, but this name is looked up then.
        with lane.lock:
            file_order = FileOrder(lane.submit(job.id, add_file), file)
        key = (job.id, file)
        self._file_orders[key] = file_order
        file_order.order.outcome.add_done_callback(lambda outcome: self._forget_file(file_order))
        return file_order

    def _forget_file(self, file_order: FileOrder) -> None:
        """Note that a file is not being made any more: who asks for it from now on orders it."""
        key = (file_order.order.owner, file_order.file)
        # Without the lock, because a lane that holds its own lock may call this. The file may have
        # been ordered again.
        if self._file_orders.get(key) is file_order:
            self._file_orders.pop(key, None)

    def _give_up_if_unwanted(self, file_order: FileOrder) -> None:
        """End the work on a file that nobody waits for."""
        with self._lock:
            if not file_order.waiting_clients:
                self._forget_file(file_order)
                file_order.order.lane.cancel(file_order.order)

    def files_in_work(self, id: str) -> list[FileProgress]:
        """The files of a scene that clients wait for."""
        return [
            FileProgress(file=file, place=each.order.lane.place_of(each.order), share=each.share)
            for (owner, file), each in list(self._file_orders.items())
            if owner == id
        ]

    def remove(self, id: str) -> None:
        """Delete a job and its files, and end all work on it."""
        with self._lock:
            job = self.by_id.pop(id, None)
            self._scene_orders.pop(id, None)
            for lane in self._lanes:
                lane.cancel_all_of(id)
            if job is None:
                return
            # Under its new name, nobody writes into the folder any more: who is about to does not
            # find it.
            doomed_folder = self.folder / f"{DELETED_PREFIX}{id}"
            with contextlib.suppress(OSError):
                job.folder.rename(doomed_folder)
        for folder in (doomed_folder, job.folder):
            shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """Kill the processes; jobs resume when a server next opens the folder."""
        with self._lock:
            self._is_closed.set()
            self.callbacks.close()
        # The threads see that their processes are gone, and end.
        for lane in self._lanes:
            lane.close()
        self._folder_lock.close()  # another server may open the folder

    def _run(self, order: Order) -> TaskFailure | None:
        """Give a job's photo to a process, wait for the scene, and record the end.

        Nothing is recorded if the server is closed meanwhile: the next server repeats the job.
        """
        id = order.owner
        with self._lock:
            if self._is_closed.is_set() or id not in self.by_id:
                return CANCELLED
            attempts = self.by_id[id].attempts + 1
            self._change(id, state="running", stage=None, line=None, attempts=attempts)
            job = self.by_id[id]

        start = time.monotonic()
        failure = self._make_scene(job, order)
        # A signal to end the whole service may reach the worker process first. Up to a second
        # passes until this process is closed, too, and then the job has not failed.
        if failure is not None and failure.kind == "died":
            self._is_closed.wait(1)
        with self._lock:
            if self._is_closed.is_set() or id not in self.by_id:
                return failure
            self._scene_orders.pop(id, None)
        self._end_or_repeat(job, failure, time.monotonic() - start)
        return failure

    def _make_scene(self, job: Job, order: Order) -> TaskFailure | None:
        """Make the scene of a job in an empty folder of results; returns why it failed, or None."""
        try:
            # An earlier server may have been stopped in the middle of this job.
            shutil.rmtree(job.results, ignore_errors=True)
            job.results.mkdir()
            job.save()
        except (OSError, InputError) as problem:
            fault = machine_fault(problem)
            if fault is not None:
                return TaskFailure("machine", reason_in_a_line(fault))
            line = f"{job.name}: cannot be stored here: {reason_in_a_line(problem)}"
            return TaskFailure("input", line)
        task = (job, None)  # None: the scene, not a further file of it
        limits = scene_limits(self.limits.work_s)
        return order.do(task, lambda event: self._note_event(job.id, event), limits)

    def _end_or_repeat(self, job: Job, failure: TaskFailure | None, seconds: float) -> None:
        """Record how the work on a job has ended, or let it wait again.

        Args:
            job: the job.
            failure: why there is no scene; None: it is finished.
            seconds: how long the work took.
        """
        # What is this machine's fault is not the photo's.
        if failure is not None and failure.kind == "machine":
            self._try_later(job.id, failure.line)
            return
        if failure is not None and failure.kind == "died" and job.attempts < MAX_ATTEMPTS:
            self._enqueue(job.id)
            return
        try:
            self._record_end(job.id, None if failure is None else error_line(job.name, failure))
        except (OSError, InputError) as problem:
            self._try_later(job.id, reason_in_a_line(machine_fault(problem) or problem))
            return
        state = "done" if failure is None else "failed"
        former = self.work_times[state]
        self.work_times[state] = WorkTimes(former.jobs + 1, former.seconds + seconds)

    def _try_later(self, id: str, reason: str) -> None:
        """Keep a photo that this machine cannot complete now, and try again after a while."""
        job = self.by_id.get(id)
        if job is None:  # it has been deleted, which may be the reason
            return
        LOG.error("error: %s: %s: kept, and tried again", job.name, reason)
        line = without_folders(f"the server cannot go on now ({reason}): it will try again")
        self._change(id, state="queued", stage=None, share=None, line=line, attempts=0)
        call_later(RETRY_S, self._enqueue, id, line)

    def _note_event(self, id: str, event: TaskEvent) -> None:
        """Note in a job's state what its process reports: {line}, or a `StageProgress`."""
        if "line" in event:
            LOG.info(event["line"])
            self._change(id, line=without_folders(event["line"]))
            return
        update = StageProgress(**event)
        self._change(id, stage=update.stage, share=update.share)

    def _record_end(self, id: str, error: str | None) -> None:
        """Record a job's end on the disk, then tell clients; delete the photo, which is private.

        OSError or InputError if the end cannot be recorded: then it has not come. Without the lock,
        because a busy disk may take a second; the folder of a deleted job has another name.

        Args:
            id: of the job.
            error: the reason for failure, None for a finished scene.
        """
        job = self.by_id.get(id)
        if job is None:
            return
        ended_job = job.model_copy(
            update={
                "state": "failed" if error else "done",
                "error": error,
                "ended": time.time(),
                "stage": None,
                "share": None,
            }
        )
        ended_job.save()
        with self._lock:
            if id not in self.by_id:
                return
            self.by_id[id] = ended_job
        for file in (job.source, job.depth, job.mask):
            # An absolute path is a file of the user, which is not ours to delete.
            if file is not None and not os.path.isabs(file):
                with contextlib.suppress(OSError):
                    (job.folder / file).unlink(missing_ok=True)
        if ended_job.callback_url is not None:
            self.callbacks.schedule(id, ended_job.callback_url, ended_job.client)
        if error:
            LOG.error("error: %s", error)

    def _tidy_until_closed(self) -> None:
        """Remove expired jobs from time to time, until the server is closed."""
        while not self._is_closed.wait(TIDY_INTERVAL_S):
            # A worker may rename a file while its size is read.
            with contextlib.suppress(OSError):
                self.remove_expired()

    def remove_expired(self) -> None:
        """Remove jobs that ended long ago, and the oldest ones while the folder is too large."""
        end_times: dict[str, float] = {}  # by the id of a job
        sizes: dict[str, int] = {}  # bytes
        # A copy of the list, because other threads add and remove jobs meanwhile.
        for job in list(self.by_id.values()):
            if job.ended is not None:
                end_times[job.id] = job.ended
                sizes[job.id] = size_of_folder(job.folder)

        total_size = sum(sizes.values())
        for id in sorted(end_times, key=end_times.__getitem__):  # the oldest first
            is_old = end_times[id] + self.limits.seconds < time.time()
            if is_old or total_size > self.limits.size:
                total_size -= sizes[id]
                self.remove(id)


def scene_limits(seconds: float) -> TaskLimits:
    """What the work on a scene, or on a file of it, may take: some time, and most of the memory.

    A GPU's driver reserves more addresses than a machine has memory, so with a GPU only the time is
    limited; torch itself says when the GPU's memory is too small.
    """
    memory = None if torch.cuda.is_available() else machine_memory()
    memory_bytes = None if memory is None else int(SCENE_MEMORY_SHARE * memory)
    return TaskLimits(seconds=seconds, memory_bytes=memory_bytes)


def error_line(name: str, failure: TaskFailure) -> str:
    """Why a photo or a file called `name` was not made, as clients may read it."""
    line = without_folders(failure.line)
    # Other lines name the photo already, or blame the server.
    return f"{name}: {line}" if failure.kind in ("time", "memory") else line


def call_later(seconds: float, function: Callable[..., None], *arguments: object) -> None:
    """Call a function after some seconds in a thread of its own, unless the program ends before."""
    timer = threading.Timer(seconds, function, arguments)
    timer.daemon = True
    timer.start()


def ignore_event(event: TaskEvent) -> None:
    """Nobody watches the progress of this work."""


def age_key(job: Job) -> tuple[float, str]:
    """What orders jobs by their age: the time of creation, and the id for those of one time."""
    return job.created, job.id


def size_of_folder(folder: Path) -> int:
    """The size in bytes of all files below a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*"))
