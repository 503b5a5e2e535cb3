"""A worker function that takes no time; the photo's name chooses success, an error or a crash."""

from __future__ import annotations

import errno
import json
import os
import threading
from typing import Any

from spackle.runtime.errors import InputError

HUNGER_BYTES = 400_000_000  # that a photo of the name "hungry" takes, and each file of its scene


def work(task: Any, tell: Any) -> None:
    """Write a scene with one layer, the photo's bytes; other files contain their name."""
    job, file = task
    how = job.name.partition(".")[0]
    if how == "full" and (job.folder.parent / "full").exists():
        raise InputError(f"{job.folder}: cannot write") from OSError(errno.ENOSPC, "disk full")
    if how == "hungry":
        bytearray(HUNGER_BYTES)
    if file is not None:
        if how == "endless" and file.endswith(".mp4"):
            tell({"stage": file, "done": 1, "total": 2})
            (job.folder.parent / "pid").write_text(str(os.getpid()))
            threading.Event().wait()
        (job.results / file).write_text(file)
        return
    tell({"stage": "base", "done": 1, "total": 2})
    if how == "slow":
        threading.Event().wait()  # until the process is killed
    if how == "bad":
        raise InputError(f"{job.name}: no depth\nat all")
    if how == "bug":
        raise KeyError("oh")
    if how == "die" or (how == "once" and job.attempts == 1):
        os._exit(9)
    if how == "path":
        raise InputError(f"'{job.folder / job.source}': no photo")
    tell({"line": "focal length <50> px"})
    depth = "" if job.depth is None else (job.folder / job.depth).read_text()
    layer = {"name": "base", "file": "base.splats", "count": 1}
    page = {"name": job.name, "layers": [layer], "depth": depth, "options": job.options}
    (job.results / "base.splats").write_bytes((job.folder / job.source).read_bytes())
    (job.results / "page.json").write_text(json.dumps(page))
