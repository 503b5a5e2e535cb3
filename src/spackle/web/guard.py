"""Who may ask, and how much a client may take: the outermost layer of the app.

A page of a stranger can make a browser send requests to this machine, and by DNS rebinding even under the stranger's
own name. Such a request gives itself away by its Host, its Origin or its Sec-Fetch-Site.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import socket
import time
from typing import NamedTuple

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spackle.errors import one_line

LOG = logging.getLogger("spackle.web")
HOST = re.compile(r"(\[[0-9a-f:.%]+\]|[0-9a-z._-]+)(?::\d{1,5})?", re.IGNORECASE)
OWN_SITES = ("same-origin", "none")  # none: typed by a person, or a bookmark
# The page has its scripts and styles from us alone, sends nothing elsewhere and stands in no other page's frame.
HEADERS = {
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


class Limits(NamedTuple):
    """Of a client; times in seconds."""

    pause: float = 10  # between two pieces of a request
    upload: float = 300  # all of an upload
    send: float = 20  # for a piece of an answer: a client that never reads must not keep a file open
    upload_bytes: int = 200_000_000  # photo and depth map


class Access(NamedTuple):
    """Who may ask a server that listens by itself; an app that another app mounts leaves that to the other."""

    token: str | None  # as the first part of the path, or as Bearer; without one nothing is written
    names: frozenset[str] = frozenset({"localhost"})  # hosts, besides numeric addresses, which cannot be rebound
    local: bool = True  # for this machine alone

    @staticmethod
    def at(host: str, address: str, token: str | None) -> Access:
        """Of a server that listens at `host`, whose numeric address is `address`."""
        if is_loopback(address):
            return Access(token)
        machine = socket.gethostname().lower()
        short = machine.partition(".")[0]
        return Access(token, frozenset({"localhost", machine, short, f"{short}.local", host.lower()}), False)

    def refusal(self, headers: Headers) -> str | None:
        """Why a request is none of a person's or a program's that wants this server, or None."""
        hosts = headers.getlist("host")
        match = HOST.fullmatch(hosts[0].strip()) if len(hosts) == 1 else None
        if match is None or not self._is_own(match[1].lower()):
            return "this server does not go by that Host name"
        ours = {f"{scheme}://{hosts[0].strip().lower()}" for scheme in ("http", "https")}  # https: by a tunnel
        if not {origin.strip().lower() for origin in headers.getlist("origin")} <= ours:
            return "asked by a page of another Origin"
        if any(site.strip().lower() not in OWN_SITES for site in headers.getlist("sec-fetch-site")):
            return "asked by a page of another site"
        return None

    def _is_own(self, name: str) -> bool:
        try:
            return is_loopback(name.strip("[]")) or not self.local
        except ValueError:
            return name.rstrip(".") in self.names

    def admits(self, scope: Scope, headers: Headers) -> Scope | None:
        """The request below the token in its path, or as it is if it has a right to ask; None without the token."""
        root, path = scope["root_path"], scope["path"]
        first = path.removeprefix(root).split("/")[1] if path.count("/") > 1 else ""
        bearer = headers.get("authorization", "").removeprefix("Bearer ")
        if self.token is None:
            return scope if scope["method"] in ("GET", "HEAD") else None
        if hmac.compare_digest(first.encode(), self.token.encode()):
            return {**scope, "root_path": f"{root}/{first}"}
        return scope if hmac.compare_digest(bearer.encode(), self.token.encode()) or path == "/healthz" else None


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a numeric address; ValueError for a name."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


class Guard:
    """Refuses, bounds, and says in every answer what a browser may do with it."""

    def __init__(self, app: ASGIApp, access: Access | None, limits: Limits) -> None:
        self.app, self.access, self.limits = app, access, limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # no WebSocket
            return await self.app(scope, receive, send) if scope["type"] == "lifespan" else None

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
                path = scope["path"].replace((self.access and self.access.token) or "/", "…", 1)
                LOG.debug(one_line(f"{scope['method']} {path} {message['status']}"))
            await asyncio.wait_for(send(message), self.limits.send)

        found = self._admitted(scope, Headers(scope=scope))
        if isinstance(found, HTTPException):
            return await JSONResponse({"error": found.detail}, found.status_code)(scope, receive, answer)
        try:
            await self.app(found, self._bounded(receive), answer)
        except asyncio.TimeoutError:
            LOG.debug("a client does not read what it asked for")  # its connection is closed
        except Exception:
            LOG.exception("this went wrong:")
            raise

    def _admitted(self, scope: Scope, headers: Headers) -> Scope | HTTPException:
        """The request as the app shall see it, or why it may not."""
        admitted: Scope | None = scope
        if self.access is not None and (line := self.access.refusal(headers)):
            return HTTPException(403, line)
        if self.access is not None and (admitted := self.access.admits(scope, headers)) is None:
            return HTTPException(401, "this needs the token that the server said as it started")
        length = int(headers.get("content-length", 0))
        return self._too_large if length > self.limits.upload_bytes or admitted is None else admitted

    @property
    def _too_large(self) -> HTTPException:
        return HTTPException(413, f"more than {self.limits.upload_bytes / 1e6:g} MB: send a smaller photo")

    def _bounded(self, receive: Receive) -> Receive:
        """Requests that come too slowly, or hold too much, end while they come."""
        start, count, whole = time.monotonic(), 0, False

        async def bounded() -> Message:
            nonlocal count, whole
            if whole:
                return await receive()  # the end of the connection, whenever that is
            try:
                message = await asyncio.wait_for(receive(), self.limits.pause)
            except asyncio.TimeoutError:
                raise HTTPException(408, "the photo came too slowly") from None
            count, whole = count + len(message.get("body", b"")), not message.get("more_body", False)
            if count > self.limits.upload_bytes:
                raise self._too_large
            if time.monotonic() - start > self.limits.upload:
                raise HTTPException(408, "the photo came too slowly")
            return message

        return bounded
