"""A worker function whose edits are never done, so that a test can stop them."""

from __future__ import annotations

import threading
from typing import Any

from spackle.web.work import SceneWork


class EndlessEdits(SceneWork):
    """Opens scenes, and never comes to an end with an edit."""

    def __call__(self, task: Any, send_event: Any) -> None:
        job, _ = task
        if job.edit is not None:
            send_event({"stage": "fill-seen", "done": 1, "total": 4})
            threading.Event().wait()  # until the process is killed
        super().__call__(task, send_event)
