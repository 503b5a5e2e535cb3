"""Jobs: worker processes turn photos into scenes; the folder of jobs outlives the server."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fastapi import HTTPException
from pydantic import BaseModel, Field

from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.task_process import WORKER_DIED, TaskEvent, TaskFunction, TaskProcess

LOG = logging.getLogger("spackle.web")
RECORD_FILE = "job.json"  # stores the state of a job, in the folder of the job
UPLOAD_PREFIX = ".new-"  # begins the names of folders of incomplete uploads
RETRY_AFTER_S = 10  # seconds after which a client may try again if the queue was full
TIDY_INTERVAL_S = 60.0  # seconds between two searches for results that are too old


class RetentionLimits(NamedTuple):
    """Limits of the folder; the oldest finished jobs are removed first."""

    seconds: float = 7 * 86400.0  # since a job ended
    size: float = 20e9  # bytes
    waiting: int = 32  # jobs in the queue


class SceneState(BaseModel):
    """The state of a photo, as clients see it."""

    id: str
    name: str
    state: Literal["queued", "running", "done", "failed"] = "queued"
    stage: str | None = Field(default=None, description="The stage in progress.")
    share: float | None = Field(
        default=None, description="Fraction of the stage that is done, 0 to 1, if known."
    )
    line: str | None = Field(default=None, description="The latest log message.")
    error: str | None = Field(default=None, description="Why it failed, in a line.")
    files: list[str] = Field(
        default=[], description="Existing files; a finished scene can make more."
    )
    created: float = Field(default_factory=time.time, description="Seconds since 1970.")
    ended: float | None = None


class Job(SceneState):
    """A photo's state, and fields that only the server uses; RECORD stores every field except the folder."""

    source: str  # the photo: a name in the job's folder, or an absolute path
    depth: str | None = None
    options: dict[str, Any] = {}
    folder: Path = Field(default=Path(), exclude=True)

    @property
    def results(self) -> Path:
        return self.folder / "results"

    def save(self) -> None:
        write_json(self.model_dump(mode="json"), self.folder / RECORD_FILE)


class Jobs:
    """The jobs in a folder, by id, and the processes that work on them; for the arguments see `create_app`.

    `work` takes (job, file) and reports {stage, done, total} or {line}. If `file` is None, `work` makes a scene of the
    photo; else it adds this file to a finished scene, in one more process.
    """

    def __init__(
        self, folder: Path, work: TaskFunction, workers: int, keep: RetentionLimits
    ) -> None:
        self.folder, self.limits = folder, keep
        self._held = contextlib.ExitStack()
        self._held.enter_context(results_folder(folder, locked=True))
        self._lock, self._closed = threading.RLock(), threading.Event()
        self.by_id: dict[str, Job] = {}  # a change replaces a job by a new one
        self._work, self._processes, self._of_thread = work, list[TaskProcess](), threading.local()
        self._running: dict[str, TaskProcess] = {}  # by job
        self._photos, self._files = ThreadPoolExecutor(workers), ThreadPoolExecutor(1)
        self._photos.submit(self._process)  # starts while the first photo is uploaded
        self._take_up()
        threading.Thread(target=self._tidy_until_closed, daemon=True).start()

    def _take_up(self) -> None:
        """Queue the unfinished jobs of an earlier server again, and delete incomplete uploads."""
        for folder in self.folder.iterdir():
            if folder.name.startswith(UPLOAD_PREFIX):
                shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError, ValueError):
                job = Job.model_validate_json((folder / RECORD_FILE).read_bytes())
                self.by_id[job.id] = job.model_copy(update={"folder": folder})
        for job in sorted(self.by_id.values(), key=lambda job: job.created):
            if job.ended is None:
                self._change(job.id, state="queued")
                self._photos.submit(self._run, job.id)

    def _change(self, id: str, **values: object) -> None:
        with self._lock:
            if id in self.by_id:  # `remove` may have deleted the job
                self.by_id[id] = self.by_id[id].model_copy(update=values)

    @contextlib.contextmanager
    def reserve_place(self) -> Iterator[Path]:
        """Reserve a place in the queue, and yield a folder that receives the photo; 429 if the queue is full."""
        folder = self.folder / f"{UPLOAD_PREFIX}{secrets.token_hex(8)}"
        with self._lock:
            waiting = len([*self.folder.glob(f"{UPLOAD_PREFIX}*")]) + sum(
                job.state == "queued" for job in self.by_id.values()
            )
            if waiting >= self.limits.waiting:
                line = f"too many photos are waiting: try again in {RETRY_AFTER_S} seconds"
                raise HTTPException(429, line, {"Retry-After": str(RETRY_AFTER_S)})
            folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(
                folder, ignore_errors=True
            )  # `add` has renamed the folder of an accepted photo

    def add(
        self, folder: Path, name: str, source: str, depth: str | None, options: dict[str, Any]
    ) -> Job:
        """Add a job for a photo in a folder that `place` yielded; `source` and `depth` may be absolute paths."""
        id = folder.name.removeprefix(UPLOAD_PREFIX)
        job = Job(id=id, name=name, source=source, depth=depth, options=options, folder=folder)
        job.save()
        with self._lock:  # `place` counts folders and jobs
            self.by_id[id] = job = job.model_copy(
                update={"folder": folder.rename(self.folder / id)}
            )
        self._photos.submit(self._run, id)
        return job

    def make_file(self, job: Job, file: str) -> Future[str | None]:
        """Add a file to a finished scene; the future's result is None, or the reason for failure."""
        return self._files.submit(lambda: self._process().do((job, file), lambda event: None))

    def remove(self, id: str) -> None:
        """Delete a job and its files, and kill the process that works on it."""
        with self._lock:
            job = self.by_id.pop(id, None)
            if process := self._running.pop(id, None):
                process.kill()
        if job:
            shutil.rmtree(job.folder, ignore_errors=True)

    def close(self) -> None:
        """Kill the processes; jobs resume when a server next opens the folder."""
        with self._lock:
            self._closed.set()
            for process in self._processes:
                process.kill()
        for pool in (self._photos, self._files):
            pool.shutdown(cancel_futures=True)
        self._held.close()

    def _process(self) -> TaskProcess:
        """The calling thread's process; a new one if the old one died."""
        process: TaskProcess | None = getattr(self._of_thread, "process", None)
        with self._lock:
            if process is None or not (process.alive or self._closed.is_set()):
                self._processes = [each for each in self._processes if each.alive]
                self._of_thread.process = process = TaskProcess(self._work)
                self._processes.append(process)
        return process

    def _run(self, id: str) -> None:
        """Give a photo to the thread's process, and wait for the scene."""
        process = self._process()
        with self._lock:
            if self._closed.is_set() or id not in self.by_id:
                return
            self._change(id, state="running")
            self._running[id], job = process, self.by_id[id]
        try:
            shutil.rmtree(job.results, ignore_errors=True)
            job.results.mkdir()
            job.save()
            error = process.do((job, None), lambda event: self._tell(id, event))
        except (OSError, InputError) as problem:
            error = f"{job.name}: cannot be stored here: {reason_in_a_line(problem)}"
        if error == WORKER_DIED:
            self._closed.wait(
                1
            )  # a signal to end the whole service may reach the worker process first
        self._running.pop(id, None)
        if not self._closed.is_set():
            self._end(id, error)

    def _tell(self, id: str, event: TaskEvent) -> None:
        if "line" in event:
            LOG.info(event["line"])
            self._change(id, line=event["line"])
        else:
            total = event["total"]
            self._change(id, stage=event["stage"], share=event["done"] / total if total else None)

    def _end(self, id: str, error: str | None) -> None:
        """Record a job's end on the disk, then tell clients; delete the photo."""
        with self._lock:
            if (job := self.by_id.get(id)) is None:
                return
            end = {"state": "failed" if error else "done", "error": error, "ended": time.time()}
            ended = job.model_copy(update={**end, "stage": None, "share": None})
            with contextlib.suppress(
                InputError
            ):  # the disk is full: the next server repeats the job
                ended.save()
                for file in (job.source, job.depth):
                    if file is not None and not os.path.isabs(file):
                        (job.folder / file).unlink(missing_ok=True)
            self.by_id[id] = ended
        if error:
            LOG.error("error: %s", error)

    def _tidy_until_closed(self) -> None:
        while not self._closed.wait(TIDY_INTERVAL_S):
            with contextlib.suppress(OSError):  # a worker may rename a file meanwhile
                self.remove_expired()

    def remove_expired(self) -> None:
        """Remove jobs that are too old, and the oldest jobs while the folder is too large."""
        ended = [
            (job.ended, sum(file.stat().st_size for file in job.folder.rglob("*")), job.id)
            for job in [*self.by_id.values()]
            if job.ended
        ]
        total = sum(size for _, size, _ in ended)
        for when, size, id in sorted(ended):
            if when + self.limits.seconds < time.time() or total > self.limits.size:
                total -= size
                self.remove(id)
