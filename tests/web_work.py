"""What stands for the network in worker processes: what it does is in the photo's name."""

from __future__ import annotations

import json
import os
import time
from typing import Any

from spackle.errors import InputError


def work(task: Any, tell: Any) -> None:
    """The scene's one layer is the photo's bytes, and a further file what the task says."""
    tell({"stage": "base", "done": 1, "total": 2})
    how = task.name.partition(".")[0]
    if how == "slow":
        time.sleep(600)
    if how == "bad":
        raise InputError(f"{task.name}: no depth\nat all")
    if how == "bug":
        raise KeyError("oh")
    if how == "die" or (how == "twice" and task.results.name == "1"):
        os._exit(9)
    if task.file is not None:
        (task.results / task.file).write_text(task.file)
        return
    tell({"line": "focal length <50> px"})
    depth = "" if task.depth is None else task.depth.read_text()
    layer = {"name": "base", "file": "base.splats", "count": 1}
    page = {"name": task.name, "layers": [layer], "depth": depth, "options": task.options}
    (task.results / "base.splats").write_bytes(task.source.read_bytes())
    (task.results / "page.json").write_text(json.dumps(page))
