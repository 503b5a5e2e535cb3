"""What the server has to give: the page's files, the last scenes, and what is going on. Nothing else can be asked."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping

from spackle.image import PHOTO_SUFFIXES
from spackle.viewer.limits import Limits
from spackle.viewer.scene import PageScene
from spackle.viewer.work import Worker

JSON = "application/json; charset=utf-8"
Body = tuple[str, bytes]  # content type, bytes


def as_json(value: object) -> bytes:
    """JSON in plain ASCII that means nothing to a reader of HTML, whatever names there are in it."""
    text = json.dumps(value, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text.encode("ascii")


class Table:
    """Every path that can be asked, to its bytes: a path is looked up as it came, and no file is ever opened."""

    def __init__(self, pages: Mapping[str, Body], limits: Limits) -> None:
        self._lock = threading.Lock()
        self._bodies: dict[str, Body] = dict(pages)
        self._scenes: list[str] = []
        self._count = 0
        self._limits = limits

    def get(self, path: str) -> Body | None:
        with self._lock:
            return self._bodies.get(path)

    def add(self, scene: PageScene) -> str:
        """A scene becomes the one that is shown; the path of its description."""
        description = as_json(scene.description)
        with self._lock:
            self._count += 1
            root = f"/scenes/{self._count}"
            self._bodies[f"{root}.json"] = (JSON, description)
            for name, content in scene.files.items():
                self._bodies[f"{root}/{name}"] = ("application/octet-stream", content)
            self._scenes.append(root)
            while len(self._scenes) > self._limits.kept_scenes:
                old = self._scenes.pop(0)
                for path in [path for path in self._bodies if path.startswith((f"{old}/", f"{old}.json"))]:
                    del self._bodies[path]
            return f"{root}.json"

    def state(self, worker: Worker) -> bytes:
        """scene.json: what is shown, what is at work, and what may be sent."""
        newest = worker.newest()
        with self._lock:
            scene = f"{self._scenes[-1]}.json" if self._scenes else None
        # One that failed is named as long as there is nothing else to see, so that a late page learns why.
        busy = newest is not None and (not newest[1].ended or scene is None)
        upload = {"suffixes": list(PHOTO_SUFFIXES), "max_bytes": self._limits.upload_bytes}
        return as_json({"scene": scene, "job": f"/jobs/{newest[0]}" if newest and busy else None, "upload": upload})
