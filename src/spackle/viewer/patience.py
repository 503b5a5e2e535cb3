"""Reading from a client that may be slow, or silent, for a limited time."""

from __future__ import annotations

import io
import socket
import time
from typing import Any


class PatientReader(io.RawIOBase):
    """A socket's bytes, each piece and all of them within the time that is allowed; TimeoutError after that.

    A timeout of the socket alone would let a client that sends a byte a second go on for ever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._pause, self._until = 0.0, 0.0

    def allow(self, pause: float, whole: float) -> None:
        """Seconds from now: for a piece, and for all that is read until this is called again."""
        self._pause, self._until = pause, time.monotonic() + whole

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self._until - time.monotonic()
        if left <= 0:
            raise TimeoutError("the client is too slow")
        self._connection.settimeout(min(self._pause, left))
        return self._connection.recv_into(buffer)
