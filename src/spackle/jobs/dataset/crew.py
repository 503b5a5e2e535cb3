"""Who makes the samples of a dataset on a cluster: workers with few photos each, replaced when they die."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from spackle.errors import InputError, reason_in_a_line
from spackle.jobs.dataset.options import DatasetOptions
from spackle.jobs.dataset.remote import RemoteMaker, setting, what_is_seen
from spackle.jobs.dataset.worker import IN_HAND, Job, Made, Maker, keep
from spackle.pseudo.photos import PhotoFile

RETRIES = 3  # of a photo whose worker died
START_S = 600.0  # for a worker to start where there is none, on a cluster that has room for it
STARTING = -1  # in place of a photo's index, for a worker that died before it had one


@dataclasses.dataclass(eq=False)
class _Worker:
    """A process on a node."""

    actor: Any
    ready: bool = False
    photos: dict[int, PhotoFile] = dataclasses.field(default_factory=dict)  # by their indices; it works on the first


class Crew:
    """Workers, what each has in hand, and what is left to do."""

    def __init__(
        self,
        ray: Any,
        options: DatasetOptions,
        output: Path,
        jobs: Sequence[Job],
        gpus: int,
        say: Callable[[str], None],
    ) -> None:
        """Hire workers.

        Args:
            ray: the package, connected to the cluster.
            options: among them how many workers.
            output: where samples wait for their shards.
            jobs: the photos.
            gpus: of each worker.
            say: told of each worker that died.
        """
        self.ray, self.options, self.output, self.say = ray, options, output, say
        self.left, self.deaths = deque(jobs), Counter[int]()  # deaths by the index of the photo
        self.expected = setting(options, Maker.of(options, output))
        self.kind = ray.remote(num_cpus=options.threads, num_gpus=gpus, max_restarts=0)(RemoteMaker)
        self.workers: list[_Worker] = []
        self.calls: dict[Any, _Worker] = {}  # answers that are awaited, in the order in which they were asked for
        for _ in range(min(options.workers, len(jobs))):
            self._hire()

    def results(self) -> Iterator[Made]:
        """Results as they come."""
        while self.left or any(worker.photos for worker in self.workers):
            self._hand_out()
            made = self._answer()
            if made is not None:
                yield made

    def end(self) -> None:
        """Let the workers go, wherever they are."""
        for worker in self.workers:
            self.ray.kill(worker.actor)

    def _hire(self) -> None:
        worker = _Worker(self.kind.remote(self.options, os.getcwd()))
        self.workers.append(worker)
        self.calls[worker.actor.begin.remote(self.expected)] = worker

    def _hand_out(self) -> None:
        """Few photos to each at a time: what is made and not yet written takes memory."""
        for have in range(IN_HAND):
            for worker in self.workers:
                if self.left and worker.ready and len(worker.photos) == have:
                    index, photo = self.left.popleft()
                    worker.photos[index] = photo
                    seen = what_is_seen(photo, self.options)
                    self.calls[worker.actor.make.remote((index, photo), seen)] = worker

    def _answer(self) -> Made | None:
        """The next photo that is done; None where a worker has started or died."""
        started = any(worker.ready for worker in self.workers)
        done, _ = self.ray.wait(list(self.calls), timeout=None if started else START_S)
        if not done:
            raise InputError(
                f"--ray {self.options.ray}: no worker could start within {START_S:g} seconds: others keep the cluster "
                "busy, or its nodes have gone: start again when it has room; the same command goes on"
            )
        worker = self.calls.pop(done[0])
        try:
            answer = self.ray.get(done[0])
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except self.ray.exceptions.RayError as error:  # the process has died, or its node
            self._replace(worker, reason_in_a_line(error))
            return None
        if not worker.ready:
            worker.ready = True
            self.deaths[STARTING] = 0
            return None
        made, data = answer
        del worker.photos[made.index]
        return keep(self.output, made, data)

    def _replace(self, worker: _Worker, why: str) -> None:
        """Another worker, and to its photos another turn."""
        self.ray.kill(worker.actor)  # where it was merely out of reach
        self.workers.remove(worker)
        self.calls = {call: other for call, other in self.calls.items() if other is not worker}
        index, photo = next(iter(worker.photos.items()), (STARTING, None))
        self.deaths[index] += 1
        where = f"--ray {self.options.ray}: as it started" if photo is None else f"{photo.path}: at this photo"
        if self.deaths[index] > RETRIES:
            raise InputError(
                f"{where} a worker died for the {self.deaths[index]}th time ({why}): most likely for want of memory: "
                "take fewer --workers on a node; the same command goes on"
            )
        self.say(f"{where} a worker died, and another takes its place ({why})")
        self.left.extendleft(reversed(worker.photos.items()))
        self._hire()
