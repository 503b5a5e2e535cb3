"""Work that makes scenes as the server does, but never ends for photos called "slow"."""

from __future__ import annotations

import threading
from typing import Any

from spackle.web.work import SceneWork


class PatientWork(SceneWork):
    """`SceneWork`, which reports a stage of each slow photo and then waits until it is killed."""

    def __call__(self, task: Any, send_event: Any) -> None:
        """Do a task, unless its photo is a slow one."""
        if isinstance(task, tuple) and task[0].name.startswith("slow"):
            send_event({"stage": "complete", "done": 1, "total": 4})
            threading.Event().wait()
        super().__call__(task, send_event)
