"""Jobs: worker processes turn photos into scenes; the folder of jobs outlives the server."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fastapi import HTTPException
from pydantic import BaseModel, Field

from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import StageProgress
from spackle.runtime.task_process import WORKER_DIED, TaskEvent, TaskFunction, TaskProcess
from spackle.web.callbacks import CallbackSender
from spackle.web.clients import OPERATOR, may_use

LOG = logging.getLogger("spackle.web")
RECORD_FILE = "job.json"  # stores the state of a job, in the folder of the job
UPLOAD_PREFIX = ".new-"  # begins the names of folders of incomplete uploads
RETRY_AFTER_S = 10  # seconds after which a client may try again if the queue was full
MIN_FREE_BYTES = 200_000_000  # that a photo with its results may take
# The task of a process that prepares for its first photo, and the stage of photos that wait for it.
WARM_UP = "warm-up"
TIDY_INTERVAL_S = 60.0  # seconds between two searches for results that are too old


class RetentionLimits(NamedTuple):
    """Limits of the folder, of which the oldest finished jobs are removed first, and of a job."""

    seconds: float = 7 * 86400.0  # since a job ended: a week
    size: float = 20e9  # bytes
    waiting: int = 32  # jobs in the queue
    work_s: float | None = None  # seconds that the work on a photo may take; None: any time


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
    folder: Path = Field(default=Path(), exclude=True)

    @property
    def results(self) -> Path:
        """The folder of the scene's files."""
        return self.folder / "results"

    def save(self) -> None:
        """Write the record of the job into its folder; InputError if the disk is full."""
        write_json(self.model_dump(mode="json"), self.folder / RECORD_FILE)


class Jobs:
    """The jobs in a folder, by id, and the processes that work on them.

    A thread belongs to each process: it hands a photo over, and waits for the scene. One more
    thread, with a process of its own, adds files to finished scenes. Jobs in `by_id` never change;
    a change replaces a job by a new one, so that readers need no lock.
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
        self._queue: list[str] = []  # ids of the jobs that wait, the next one first
        self._lock = threading.RLock()  # of `by_id`, of the queue, and of the processes
        self._is_closed = threading.Event()
        self._is_warming_up = False
        self._work = work
        self._processes: list[TaskProcess] = []
        self._own_process = threading.local()  # the process of the calling thread
        self._process_of_job: dict[str, TaskProcess] = {}  # by the id of a running job
        self.work_times = {"done": WorkTimes(), "failed": WorkTimes()}
        self._timed_out: set[str] = set()  # ids of running jobs that took too long
        # Each process that makes scenes has a number, which chooses its GPU. A single process, and
        # the one that adds files, have none: they use torch's default GPU.
        self._gpu_numbers = iter(range(workers) if workers > 1 else ())
        self._scene_threads = ThreadPoolExecutor(workers, initializer=self._take_gpu_number)
        self._file_thread = ThreadPoolExecutor(1)

        # A process takes seconds to start: it does so while the first photo is uploaded.
        self._scene_threads.submit(self._process)
        self._resume_jobs()
        threading.Thread(target=self._tidy_until_closed, daemon=True).start()

    def _resume_jobs(self) -> None:
        """Queue the unfinished jobs of an earlier server again, and delete incomplete uploads."""
        for folder in self.folder.iterdir():
            if folder.name.startswith(UPLOAD_PREFIX):
                shutil.rmtree(folder, ignore_errors=True)
            # A folder without a readable record is no job, and is left alone.
            with contextlib.suppress(OSError, ValueError):
                job = Job.model_validate_json((folder / RECORD_FILE).read_bytes())
                self.by_id[job.id] = job.model_copy(update={"folder": folder})

        # The photo that came first is completed first.
        for job in sorted(self.by_id.values(), key=lambda job: job.created):
            if job.ended is None:
                self._change(job.id, state="queued")
                self._enqueue(job.id)

    def _enqueue(self, id: str) -> None:
        """Let a job wait for a process."""
        with self._lock:
            self._queue.append(id)
            self._scene_threads.submit(self._run, id)

    def _dequeue(self, id: str) -> None:
        """Note that a job waits no more: it runs, or is deleted."""
        with self._lock, contextlib.suppress(ValueError):
            self._queue.remove(id)

    def place_of(self, job: Job) -> int | None:
        """The number of jobs that come before one that waits; None for one that does not wait."""
        if job.state != "queued":
            return None
        try:
            return self._queue.index(job.id)
        except ValueError:  # it has begun to run, or was deleted
            return None

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
        with self._lock:
            if not self._processes:
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
        with self._lock:
            self._change(id, callback_url=None)
            # If the disk is full, or the job has just been deleted, there is nothing to be done.
            if id in self.by_id:
                with contextlib.suppress(InputError, OSError):
                    self.by_id[id].save()

    def warm_up(self) -> None:
        """Have a process prepare for its first photo, if its work can do that; returns at once.

        The work is then called with the task `WARM_UP`. Photos that come meanwhile wait, and their
        state says so.
        """
        if getattr(self._work, "prepares_for_photos", False):
            self._is_warming_up = True
            self._scene_threads.submit(self._warm_up)

    def _warm_up(self) -> None:
        """Do the task `WARM_UP` in the process of the calling thread."""

        def ignore_event(event: TaskEvent) -> None:
            """Nobody waits for this work yet."""

        try:
            # What goes wrong here goes wrong again with the first photo, whose sender is told.
            error = self._process().do(WARM_UP, ignore_event)
            LOG.debug("prepared for the first photo: %s", error or "done")
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
                raise HTTPException(
                    429,
                    f"too many photos are waiting: try again in {RETRY_AFTER_S} seconds",
                    {"Retry-After": str(RETRY_AFTER_S)},
                )
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
        if self._is_warming_up:
            job = job.model_copy(update={"stage": WARM_UP})
        # `reserve_place` counts folders and jobs, so the two change together.
        with self._lock:
            job_folder = folder.rename(self.folder / id)
            job = job.model_copy(update={"folder": job_folder})
            self.by_id[id] = job
        self._enqueue(id)
        return job

    def make_file(self, job: Job, file: str) -> Future[str | None]:
        """Add a file to a finished scene, in a thread; returns at once.

        The result of the future is None when the file is made, or the reason for failure.

        Args:
            job: of the scene.
            file: the name of the file, such as "scene.glb".
        """

        def ignore_event(event: TaskEvent) -> None:
            """The progress of a single file is not shown."""

        def add_file() -> str | None:
            return self._process().do((job, file), ignore_event)

        return self._file_thread.submit(add_file)

    def remove(self, id: str) -> None:
        """Delete a job and its files, and kill the process that works on it."""
        with self._lock:
            job = self.by_id.pop(id, None)
            self._dequeue(id)
            process = self._process_of_job.pop(id, None)
            if process is not None:
                process.kill()
        if job is not None:
            shutil.rmtree(job.folder, ignore_errors=True)

    def close(self) -> None:
        """Kill the processes; jobs resume when a server next opens the folder."""
        with self._lock:
            self._is_closed.set()
            self.callbacks.close()
            for process in self._processes:
                process.kill()
        # The threads see that their processes are gone, and end.
        for pool in (self._scene_threads, self._file_thread):
            pool.shutdown(cancel_futures=True)
        self._folder_lock.close()  # another server may open the folder

    def _take_gpu_number(self) -> None:
        """Give the calling thread, and so its process, the next number of a GPU, if any is left."""
        self._own_process.gpu_number = next(self._gpu_numbers, None)

    def _process(self) -> TaskProcess:
        """The worker process of the calling thread; a new one if there is none, or it died."""
        # `_own_process` holds another value in each thread.
        process: TaskProcess | None = getattr(self._own_process, "process", None)
        with self._lock:
            # `close` kills the processes. A process that died after that is not replaced: it is
            # returned dead, and the tasks that it gets fail.
            is_dead = process is not None and not process.alive
            if process is None or (is_dead and not self._is_closed.is_set()):
                # A process that replaces a dead one takes over its GPU.
                gpu_number = getattr(self._own_process, "gpu_number", None)
                process = TaskProcess(self._work, gpu_number)
                self._own_process.process = process
                alive = [each for each in self._processes if each.alive]
                self._processes = [*alive, process]
        return process

    def _run(self, id: str) -> None:
        """Give a job's photo to the thread's process, wait for the scene, and record the end.

        Nothing is recorded if the server is closed meanwhile: the next server repeats the job.
        """
        process = self._process()
        with self._lock:
            self._dequeue(id)
            if self._is_closed.is_set() or id not in self.by_id:
                return
            self._change(id, state="running", stage=None)
            self._process_of_job[id] = process
            job = self.by_id[id]

        start = time.monotonic()
        try:
            # An earlier server may have been stopped in the middle of this job.
            shutil.rmtree(job.results, ignore_errors=True)
            job.results.mkdir()
            job.save()
            task = (job, None)  # None: the scene, not a further file of it
            # The reason why the scene could not be made; None if it is finished.
            with self._time_limit(id, process):
                error = process.do(task, lambda event: self._note_event(id, event))
        except (OSError, InputError) as problem:
            error = f"{job.name}: cannot be stored here: {reason_in_a_line(problem)}"

        # A signal to end the whole service may reach the worker process first. Up to a second
        # passes until this process is closed, too, and then the job has not failed.
        if error == WORKER_DIED:
            self._is_closed.wait(1)
        with self._lock:
            self._process_of_job.pop(id, None)
            if id in self._timed_out:
                self._timed_out.discard(id)
                error = f"{job.name}: took longer than {self.limits.work_s:g} seconds, the limit"
            if not self._is_closed.is_set() and id in self.by_id:
                state = "failed" if error else "done"
                former = self.work_times[state]
                seconds = former.seconds + time.monotonic() - start
                self.work_times[state] = WorkTimes(former.jobs + 1, seconds)
        if not self._is_closed.is_set():
            self._record_end(id, error)

    @contextlib.contextmanager
    def _time_limit(self, id: str, process: TaskProcess) -> Iterator[None]:
        """Kill the process of a job if the block takes longer than the limit."""
        if self.limits.work_s is None:
            yield
            return

        def end_job() -> None:
            with self._lock:
                # The job may have ended in this moment, and the process may have another one.
                if self._process_of_job.get(id) is process:
                    self._timed_out.add(id)
                    process.kill()

        timer = threading.Timer(self.limits.work_s, end_job)
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _note_event(self, id: str, event: TaskEvent) -> None:
        """Note in a job's state what its process reports: {line}, or a `StageProgress`."""
        if "line" in event:
            LOG.info(event["line"])
            self._change(id, line=event["line"])
            return
        update = StageProgress(**event)
        self._change(id, stage=update.stage, share=update.share)

    def _record_end(self, id: str, error: str | None) -> None:
        """Record a job's end on the disk, then tell clients; delete the photo, which is private.

        `error` is the reason for failure, None for a finished scene.
        """
        with self._lock:
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
            # If the disk is full, the next server repeats the job, and needs the photo.
            with contextlib.suppress(InputError):
                ended_job.save()
                for file in (job.source, job.depth, job.mask):
                    # An absolute path is a file of the user, which is not ours to delete.
                    if file is not None and not os.path.isabs(file):
                        (job.folder / file).unlink(missing_ok=True)
            self.by_id[id] = ended_job
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


def age_key(job: Job) -> tuple[float, str]:
    """What orders jobs by their age: the time of creation, and the id for those of one time."""
    return job.created, job.id


def size_of_folder(folder: Path) -> int:
    """The size in bytes of all files below a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*"))
