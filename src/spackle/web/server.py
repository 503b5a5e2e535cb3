"""A server for the app, which withstands slow and silent clients."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 512  # at a time; more are refused
SILENT_S = 10.0  # in which a client must send the whole head of a request, or read what is sent


def server_of(app: FastAPI, silent: float = SILENT_S) -> uvicorn.Server:
    """A server whose `run(sockets=[listener])` serves until Ctrl-C or SIGTERM; then the app's processes end."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=type("Protocol", (PatientProtocol,), {"silent": silent}),
            ws="none",
            log_config=None,
            log_level="critical",
            server_header=False,
            proxy_headers=False,
            limit_concurrency=CONNECTIONS,
            timeout_graceful_shutdown=1,  # seconds for clients that still watch a photo
        )
    )


class PatientProtocol(H11Protocol):
    """Closes the connection of a silent client, unless the client waits for an answer."""

    silent = SILENT_S

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        # asyncio sets it only if the listener names its protocol; without it an answer's second part waits for 40 ms.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._look(self)

    def _look(self, before: Any) -> None:
        waiting = self.cycle is None or self.cycle.response_complete
        if self.transport.is_closing() or (waiting and self.cycle is before):
            self.transport.abort()  # `close` would first send data that nobody reads
        else:
            self.loop.call_later(self.silent, self._look, self.cycle if waiting else self)
