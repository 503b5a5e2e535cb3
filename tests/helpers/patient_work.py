"""Work that makes scenes as the server does, but takes longer, or makes less."""

from __future__ import annotations

import dataclasses
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

from spackle.web.jobs import WARM_UP
from spackle.web.work import SceneWork


class PatientWork(SceneWork):
    """`SceneWork`, which reports a stage of each slow photo and then waits until it is killed."""

    def __call__(self, task: Any, send_event: Any) -> None:
        """Do a task, unless its photo is a slow one."""
        if isinstance(task, tuple) and task[0].name.startswith("slow"):
            send_event({"stage": "complete", "done": 1, "total": 4})
            threading.Event().wait()
        super().__call__(task, send_event)


@dataclasses.dataclass
class SlowStart(SceneWork):
    """`SceneWork` whose warm-up takes until a file exists."""

    go_on: Path = Path()

    def __call__(self, task: Any, send_event: Any) -> None:
        """Do a task."""
        if task == WARM_UP:
            while not self.go_on.exists():
                time.sleep(0.01)
        else:
            super().__call__(task, send_event)


@dataclasses.dataclass
class BriefWork(SceneWork):
    """`SceneWork` whose videos for sharing have a length of one's choice."""

    shared_seconds: float = 2.0

    def __call__(self, task: Any, send_event: Any) -> None:
        """Do a task."""
        with mock.patch("spackle.web.shared_videos.SHARED_SECONDS", self.shared_seconds):
            super().__call__(task, send_event)
