"""The outermost layer of the app: checks access and the size of uploads.

A stranger's page can make a browser send requests to this machine; by DNS rebinding, even under the stranger's host
name. The headers Host, Origin and Sec-Fetch-Site reveal such a request.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import socket
from typing import NamedTuple

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spackle.runtime.errors import printable_line

LOG = logging.getLogger("spackle.web")
HOST_PATTERN = re.compile(r"(\[[0-9a-f:.%]+\]|[0-9a-z._-]+)(?::\d{1,5})?", re.IGNORECASE)
OWN_SITES = {"same-origin", "none"}  # none: an address that a person typed, or a bookmark
MAX_SEND_S = 20.0  # seconds that a client may take to read a part of an answer
MAX_UPLOAD_BYTES = 200_000_000  # of an upload: photo and depth map
# The page loads scripts and styles from this server only and sends nothing elsewhere; no other page can frame it.
SECURITY_HEADERS = {
    "Cache-Control": "no-store",  # a photo is private
    "Content-Security-Policy": "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data: blob:; media-src blob:; worker-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Server": "spackle",  # strangers learn no versions
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Access(NamedTuple):
    """Access rules of a stand-alone server."""

    token: (
        str | None
    )  # a request has it as the first part of the path, or as Bearer; None: no photo is accepted
    names: frozenset[str] = frozenset({"localhost"})  # accepted host names
    local: bool = True  # only this machine can connect

    @staticmethod
    def for_listener(host: str, address: str, token: str | None) -> Access:
        """The rules for a server that listens at `host`, whose numeric address is `address`."""
        if is_loopback(address):
            return Access(token)
        machine = socket.gethostname().lower()
        short = machine.partition(".")[0]
        return Access(
            token, frozenset({"localhost", machine, short, f"{short}.local", host.lower()}), False
        )

    def authorize(self, scope: Scope, headers: Headers) -> Scope:
        """Check a request, and strip the token from its path; HTTPException without a valid token."""
        hosts = headers.getlist("host")
        match = HOST_PATTERN.fullmatch(hosts[0].strip()) if len(hosts) == 1 else None
        if match is None or not self._is_own(match[1].lower()):
            raise HTTPException(403, "this server does not have that Host name")
        ours = {
            f"{scheme}://{hosts[0].strip().lower()}" for scheme in ("http", "https")
        }  # https: through a tunnel
        sites = {site.strip().lower() for site in headers.getlist("sec-fetch-site")}
        if (
            not {origin.strip().lower() for origin in headers.getlist("origin")} <= ours
            or not sites <= OWN_SITES
        ):
            raise HTTPException(403, "the request comes from a page of another site")
        root, path = scope["root_path"], scope["path"]
        first = path.removeprefix(root).split("/")[1] if path.count("/") > 1 else ""
        if self._is_token(first):
            return {**scope, "root_path": f"{root}/{first}"}
        may_ask = scope["method"] in ("GET", "HEAD") if self.token is None else path == "/healthz"
        if not may_ask and not self._is_token(
            headers.get("authorization", "").removeprefix("Bearer ")
        ):
            closed = "this page takes no photos: it was opened without a token"
            raise HTTPException(
                401, "this needs the token that the server printed" if self.token else closed
            )
        return scope

    def _is_own(self, name: str) -> bool:
        try:  # DNS rebinding needs a name: a numeric host is safe
            return is_loopback(name.strip("[]")) or not self.local
        except ValueError:
            return name.rstrip(".") in self.names

    def _is_token(self, word: str) -> bool:
        return self.token is not None and hmac.compare_digest(word.encode(), self.token.encode())


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a numeric address; ValueError for a name."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


class Guard:
    """Middleware that refuses or limits requests, and sets security headers in every answer."""

    def __init__(self, app: ASGIApp, access: Access | None, max_bytes: int) -> None:
        self.app, self.access, self.max_bytes = app, access, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # no WebSocket
            return await self.app(scope, receive, send) if scope["type"] == "lifespan" else None
        headers, count = Headers(scope=scope), 0

        def check(size: int) -> None:
            if size > self.max_bytes:
                raise HTTPException(
                    413, f"more than {self.max_bytes / 1e6:g} MB: send a smaller photo"
                )

        async def bounded() -> Message:
            nonlocal count
            message = await receive()
            check(count := count + len(message.get("body", b"")))
            return message

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(SECURITY_HEADERS)
                path = scope["path"].replace((self.access and self.access.token) or "/", "…", 1)
                LOG.debug(printable_line(f"{scope['method']} {path} {message['status']}"))
            await asyncio.wait_for(send(message), MAX_SEND_S)

        try:
            admitted = scope if self.access is None else self.access.authorize(scope, headers)
            check(int(headers.get("content-length", 0)))
            await self.app(admitted, bounded, answer)
        except HTTPException as error:
            await JSONResponse({"error": error.detail}, error.status_code)(scope, receive, answer)
        except (asyncio.TimeoutError, ClientDisconnect):
            LOG.debug("a client disconnected, or does not read its answer")
        except Exception:
            LOG.exception("this went wrong:")
            raise
