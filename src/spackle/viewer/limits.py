"""How much a client may take of the viewer's server: time, bytes and places."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Limits:
    """Times are in seconds. The server is for a few people: what is refused is far above what a page asks for."""

    request: float = 15  # from one answer to the end of the next request's headers
    pause: float = 10  # between two pieces of an upload
    upload: float = 300  # all of an upload
    send: float = 20  # for a piece of an answer: a client that never reads must not keep a thread
    heartbeat: float = 10  # of a silent event stream; it is how a listener that has gone shows
    stop: float = 0.5  # for work to end by itself once the server is stopped
    connections: int = 64  # at a time, a thread each
    listeners: int = 16  # of all event streams
    upload_bytes: int = 100_000_000
    kept_scenes: int = 2  # what is shown, and what a page may still be loading
    kept_jobs: int = 4


DEFAULT = Limits()
