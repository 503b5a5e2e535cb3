"""Numbers for those who watch over the server, in the format of Prometheus."""

from __future__ import annotations

import shutil
from collections import Counter as Tally
from collections.abc import Iterator
from typing import Any, get_args

from starlette.responses import Response

import spackle
from spackle.web.jobs import Jobs, JobState

METHODS = {"GET", "HEAD", "POST", "DELETE", "OPTIONS"}  # others are counted together


class JobsCollector:
    """The numbers of jobs, read when Prometheus asks."""

    def __init__(self, jobs: Jobs) -> None:
        """Watch over the jobs of a server."""
        self.jobs = jobs

    def collect(self) -> Iterator[Any]:
        """Each number, with what it means."""
        from prometheus_client.core import GaugeMetricFamily, SummaryMetricFamily

        scenes = GaugeMetricFamily(
            "spackle_scenes", "Photos and scenes on the disk, by state", labels=["state"]
        )
        numbers = Tally(job.state for job in list(self.jobs.by_id.values()))
        for state in get_args(JobState):
            scenes.add_metric([state], numbers[state])
        yield scenes

        work = SummaryMetricFamily(
            "spackle_work_seconds",
            "Seconds of work on a photo or edit that has ended since the start, by its end",
            labels=["state"],
        )
        for state, times in self.jobs.work_times.items():
            work.add_metric([state], count_value=times.jobs, sum_value=times.seconds)
        yield work

        yield GaugeMetricFamily(
            "spackle_queue_limit", "Photos that may wait", value=self.jobs.limits.waiting
        )
        yield GaugeMetricFamily(
            "spackle_disk_free_bytes",
            "Free space of the disk with the scenes",
            value=shutil.disk_usage(self.jobs.folder).free,
        )


class Metrics:
    """All numbers of a server."""

    def __init__(self, jobs: Jobs) -> None:
        """Start to count; ModuleNotFoundError if prometheus-client is not installed."""
        import prometheus_client

        self.registry = prometheus_client.CollectorRegistry()
        self.registry.register(JobsCollector(jobs))
        prometheus_client.Info("spackle", "What runs here", registry=self.registry).info(
            {"version": spackle.__version__}
        )
        self.answers = prometheus_client.Counter(
            "spackle_http_answers",
            "Answers to requests, by method and status",
            ["method", "status"],
            registry=self.registry,
        )

    def count_answer(self, method: str, status: int) -> None:
        """Count the answer to a request."""
        self.answers.labels(method if method in METHODS else "other", str(status)).inc()

    def answer(self) -> Response:
        """All numbers, as Prometheus reads them."""
        from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

        return Response(generate_latest(self.registry), media_type=CONTENT_TYPE_PLAIN_0_0_4)
