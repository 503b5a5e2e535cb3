"""Jobs: photos that become scenes, each worker process at one of them, in a folder that survives the server."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, Field

from spackle.errors import InputError, reason_in_a_line
from spackle.files import write_json
from spackle.folders import results_folder
from spackle.task_process import Event, TaskProcess, Work

LOG = logging.getLogger("spackle.web")
RECORD, NEW = "job.json", ".new-"  # a job's own file; how folders of uploads begin that are not whole yet
ATTEMPTS = 2  # runs that a job may begin: one that takes the server down with it must not do so for ever
ENDED = "the server ended twice while it worked on this photo"
REMOVED = "this photo was removed"
LINES = 50  # events that late listeners get
LOOK_S = 60.0  # between two looks for results that are too old


class Keep(NamedTuple):
    """What the folder may hold; the oldest jobs that have ended go first."""

    seconds: float = 7 * 86400.0  # since a job ended
    size: float = 20e9  # bytes
    waiting: int = 32  # jobs in the queue


class SceneTask(NamedTuple):
    """What a process does: a photo or a scene to show, or one more `file` of a scene that is done."""

    source: Path
    depth: Path | None
    name: str  # for people; no file is ever called so
    options: dict[str, Any]
    results: Path  # the folder for what is made
    file: str | None


class SceneState(BaseModel):
    """A photo on its way to a scene."""

    id: str
    name: str
    state: Literal["queued", "running", "done", "failed"] = "queued"
    stage: str | None = Field(default=None, description="What is done now.")
    share: float | None = Field(default=None, description="How much of the stage is done, 0 to 1, where it is known.")
    error: str | None = Field(default=None, description="Why it failed, in a line.")
    created: float = Field(default_factory=time.time, description="Seconds since 1970.")
    ended: float | None = None


class Job(SceneState):
    """What the server alone knows of it; RECORD holds all but the last two values."""

    source: str  # below the job's folder, or elsewhere on this machine
    depth: str | None = None
    options: dict[str, Any] = {}
    attempts: int = 0
    folder: Path = Field(Path(), exclude=True)
    events: list[tuple[int, Event]] = Field(default=[], exclude=True)  # numbered in the order they came

    @property
    def results(self) -> Path:
        """Of the last attempt: a process that outlives its server may still write into that of the one before."""
        return self.folder / str(self.attempts)

    def save(self) -> None:
        write_json(self.model_dump(mode="json"), self.folder / RECORD, durable=True)

    def tell(self, event: Event) -> None:
        """Add {stage, done, total}, {line} or {state, error} for listeners; one stage replaces the other."""
        number = self.events[-1][0] + 1 if self.events else 1
        kept = [(k, old) for k, old in self.events if not ("stage" in event and "stage" in old)]
        self.events = [*kept, (number, event)][-LINES:]  # in one step: listeners read without a lock
        if "line" in event:
            LOG.info(event["line"])
        if "stage" in event:
            self.stage, self.share = event["stage"], event["done"] / event["total"] if event["total"] else None


class FullError(Exception):
    """There is no place in the queue, and perhaps one in `seconds`."""

    def __init__(self, seconds: int) -> None:
        super().__init__(f"too many photos are waiting: try again in {seconds} seconds")
        self.seconds = seconds


class Jobs:
    """The jobs in a folder, and the processes that work on them.

    Args:
        folder: holds a folder for each job; InputError where another server uses it.
        work: does a `SceneTask` and tells how far it is.
        workers: number of processes.
        keep: what the folder may hold.
    """

    def __init__(self, folder: Path, work: Work, workers: int, keep: Keep) -> None:
        self.folder, self.keep, self.closing = folder, keep, False
        self._held = contextlib.ExitStack()
        self._held.enter_context(results_folder(folder, alone=True))
        self._changed = threading.Condition()
        self._jobs: dict[str, Job] = {}
        self._queue: deque[tuple[Job, str | None]] = deque()
        self._files: dict[tuple[str, str], Future[str | None]] = {}  # being made, by job and name
        self._running: dict[str, TaskProcess] = {}  # by job
        self._receiving, self._pace = 0, 10.0  # photos; seconds that a job took
        self._take_up()
        self._threads = [threading.Thread(target=self._run, args=(work,), daemon=True) for _ in range(workers)]
        for thread in self._threads:
            thread.start()

    def _take_up(self) -> None:
        """What an earlier server left waits again; uploads that were not whole go."""
        for folder in self.folder.iterdir():
            if folder.name.startswith(NEW):
                shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError, ValueError):
                job = Job.model_validate_json((folder / RECORD).read_bytes())
                job.folder = folder
                self._jobs[job.id] = job
        for job in sorted(self._jobs.values(), key=lambda job: job.created):
            if job.state == "running" and job.attempts >= ATTEMPTS:
                self._end(job, ENDED)
            elif job.ended is None:
                job.state = "queued"
                self._queue.append((job, None))

    def get(self, id: str) -> Job | None:
        return self._jobs.get(id)

    @contextlib.contextmanager
    def place(self) -> Iterator[Path]:
        """Hold a place in the queue while a photo is received into the folder that is yielded; FullError."""
        with self._changed:
            if len(self._queue) + self._receiving >= self.keep.waiting:
                raise FullError(max(1, round(self._pace / len(self._threads))))
            self._receiving += 1
        folder = self.folder / f"{NEW}{secrets.token_hex(8)}"
        try:
            folder.mkdir()
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)  # it has another name where it was added
            with self._changed:
                self._receiving -= 1

    def add(self, folder: Path, name: str, source: str, depth: str | None, options: dict[str, Any]) -> Job:
        """The job of what lies in a folder of `place`; `source` may lie elsewhere."""
        id = folder.name.removeprefix(NEW)
        job = Job(id=id, name=name, source=source, depth=depth, options=options, folder=folder)
        job.save()
        job.folder = folder.rename(self.folder / id)
        with self._changed:
            self._jobs[id] = job
            self._queue.append((job, None))
            self._changed.notify()
        return job

    def make(self, job: Job, file: str) -> Future[str | None]:
        """One more file of a scene that is done, before the jobs that wait: None, or why it could not be made."""
        with self._changed:
            if (job.id, file) not in self._files:
                self._files[job.id, file] = Future()
                self._queue.appendleft((job, file))
                self._changed.notify()
            return self._files[job.id, file]

    def remove(self, job: Job) -> None:
        """Forget a job and its files; the process that works on it is killed."""
        with self._changed:
            self._jobs.pop(job.id, None)
            self._queue = deque(entry for entry in self._queue if entry[0] is not job)
            for key in [key for key in self._files if key[0] == job.id]:
                self._files.pop(key).set_result(REMOVED)
            if process := self._running.pop(job.id, None):
                process.kill()
        shutil.rmtree(job.folder, ignore_errors=True)
        job.tell({"state": "failed", "error": REMOVED})

    def close(self) -> None:
        """Kill the processes; jobs go on when a server next takes up the folder."""
        with self._changed:
            self.closing = True
            self._changed.notify_all()
            for process in self._running.values():
                process.kill()
        for thread in self._threads:
            thread.join()
        self._held.close()

    def _run(self, work: Work) -> None:
        """The thread of a process: hand it one task after the other, and start another where it died."""
        process = TaskProcess(work)
        while (entry := self._next()) is not None:
            if not process.alive:
                process = TaskProcess(work)
            self._do(process, *entry)
        process.kill()

    def _next(self) -> tuple[Job, str | None] | None:
        while True:
            with self._changed:
                if self.closing:
                    return None
                if self._queue:
                    return self._queue.popleft()
                self._changed.wait(LOOK_S)
            self.tidy()

    def _do(self, process: TaskProcess, job: Job, file: str | None) -> None:
        with self._changed:
            if self.closing or job.id not in self._jobs:
                return
            self._running[job.id] = process
        start, depth = time.monotonic(), None if job.depth is None else job.folder / job.depth
        try:
            if file is None:
                job.state, job.attempts = "running", job.attempts + 1
                shutil.rmtree(job.results, ignore_errors=True)
                job.results.mkdir()
                job.save()
            task = SceneTask(job.folder / job.source, depth, job.name, job.options, job.results, file)
            error = process.do(task, job.tell)
        except (OSError, InputError) as problem:
            error = f"{job.name}: cannot be kept here: {reason_in_a_line(problem)}"
        with self._changed:
            ours = self._running.pop(job.id, None) is process
            if file is not None and (made := self._files.pop((job.id, file), None)):
                made.set_result(error)
        if file is None and ours and not self.closing:
            self._pace = time.monotonic() - start
            self._end(job, error)
            self.tidy()

    def _end(self, job: Job, error: str | None) -> None:
        """Keep a job's end on the disk, and then tell it; the photo goes."""
        end = {
            "state": "failed" if error else "done",
            "error": error,
            "ended": time.time(),
            "stage": None,
            "share": None,
        }
        with contextlib.suppress(InputError):  # the disk is full: it is said here, and done again by the next server
            job.model_copy(update=end).save()
            for file in (job.source, job.depth):
                if file is not None and not os.path.isabs(file):
                    (job.folder / file).unlink(missing_ok=True)
        for name, value in end.items():
            setattr(job, name, value)
        if error:
            LOG.error("error: %s", error)
        job.tell({"state": job.state, "error": error})

    def tidy(self) -> None:
        """Remove what is too old, and the oldest while the folder is too large."""
        ended = [(job.ended, _size(job.folder), job) for job in [*self._jobs.values()] if job.ended]
        total = sum(size for _, size, _ in ended)
        for when, size, job in sorted(ended, key=lambda each: each[0]):
            if when + self.keep.seconds < time.time() or total > self.keep.size:
                total -= size
                self.remove(job)


def _size(folder: Path) -> int:
    """Bytes of the files below a folder; what is written just now counts nothing."""
    total = 0
    for file in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += file.stat().st_size
    return total
