"""The viewer's server: a page, its scenes, and photos that are completed one at a time.

It is the standard library's, a thread for a connection: a few people look at one page, and what they load is whole
files out of memory. A framework would be one more thing to install, to keep up with and to trust with a photo.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from io import BufferedIOBase
from pathlib import Path

from spackle.errors import InputError
from spackle.viewer.guard import DEFAULT, Declared, Limits, check_photo, receive, split_depth
from spackle.viewer.handler import Body, Listener
from spackle.viewer.page import PageScene
from spackle.viewer.work import Tell

# A photo's file, its name for people, where progress goes; by keyword `base`, `disparity`, `depth`, as the page chose.
Complete = Callable[..., PageScene]
HOST = "127.0.0.1"


class ViewerServer:
    """Serves from `start` until `close`; as a context manager, for the block.

    Args:
        pages: the page's files, URL path to content type and bytes.
        complete: what turns an uploaded photo into a scene; an InputError of it is shown as a line.
        host: where to listen; anything but this machine's own addresses lets others in.
        port: 0 takes a free one.
        limits: what a client may take.
        log: gets a line for each request.
        bases: that the page offers for photos.
        token: a secret part of the page's address, checked on every request; "" answers everybody on this machine.

    Raises:
        InputError: nothing can listen there.
    """

    def __init__(
        self,
        pages: Mapping[str, Body],
        complete: Complete,
        *,
        host: str = HOST,
        port: int = 0,
        limits: Limits = DEFAULT,
        log: Callable[[str], None] = lambda line: None,
        bases: Sequence[str] = (),
        token: str = "",
    ) -> None:
        self._http = Listener(host, port, pages, limits, log, self._take, bases, token)
        self._worker = self._http.worker
        self.uploads = tempfile.TemporaryDirectory(prefix="spackle-view-")
        self._complete, self._limits = complete, limits
        self.host = host
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.1,), daemon=True, name="viewer")

    @property
    def port(self) -> int:
        return int(self._http.server_address[1])

    @property
    def local(self) -> bool:
        """Whether this machine alone can reach it."""
        return self._http.local

    @property
    def url(self) -> str:
        """For a browser on this machine."""
        address = str(self._http.server_address[0])
        return self.url_at({"0.0.0.0": HOST, "::": "::1"}.get(address, address))

    def url_at(self, address: str) -> str:
        """For a browser that reaches this machine by that address."""
        root = f"http://{f'[{address}]' if ':' in address else address}:{self.port}/"
        return root + (f"{self._http.token}/" if self._http.token else "")

    def show(self, scene: PageScene) -> str:
        """Make a scene the one that the page shows; the path of its description."""
        return self._http.routes.add(scene)

    def work(self, job: Callable[[Tell], PageScene]) -> None:
        """Do a job whose scene is then shown; the page shows its progress meanwhile.

        Raises:
            RuntimeError: another is at work.
        """
        if not self._worker.claim():
            raise RuntimeError("another photo is at work")
        self._worker.start(lambda tell: self.show(job(tell)))

    def start(self) -> None:
        """Answer from now on, in threads."""
        self._thread.start()

    def close(self) -> bool:
        """Stop answering and remove what was uploaded; False where a job is still at work, in a daemon thread."""
        ended = self._worker.stop(self._limits.stop)
        if self._thread.is_alive():
            self._http.shutdown()
            self._thread.join()
        self._http.server_close()
        self.uploads.cleanup()
        return ended

    def __enter__(self) -> ViewerServer:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _take(self, stream: BufferedIOBase, promise: Declared) -> int:
        """Receive a photo and start its completion; the worker's place has been claimed."""
        path = Path(tempfile.mkdtemp(dir=self.uploads.name)) / f"upload{promise.suffix}"

        def remove() -> None:
            shutil.rmtree(path.parent, ignore_errors=True)

        choices: dict[str, object] = dict(promise.choices)

        def job(tell: Tell) -> str:
            try:
                return self.show(self._complete(path, promise.name, tell, **choices))
            except InputError as error:
                line = str(error).replace(str(path), promise.name).replace(f"{path.parent}{os.sep}", "")
                raise InputError(line) from error

        try:
            receive(stream, path, promise, self._limits)
            if depth := split_depth(path, promise):
                choices["depth"] = depth
            check_photo(path, promise.name)
            return self._worker.start(job, remove)
        except BaseException:
            remove()
            raise
