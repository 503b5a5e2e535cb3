"""The outermost layer of the app: checks access and the size of uploads.

A stranger's page can make a browser send requests to this machine; by DNS rebinding, even under the
stranger's host name. The headers Host, Origin and Sec-Fetch-Site reveal such a request.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import socket
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spackle.runtime.errors import printable_line, reason_in_a_line
from spackle.runtime.task_process import machine_fault
from spackle.web.clients import CLIENT_KEY, OPERATOR, Client
from spackle.web.description import REASONS
from spackle.web.failures import RETRY_AFTER_S, no_space
from spackle.web.public_address import LOCAL_ONLY, PublicAddress
from spackle.web.scene_links import SHARED_PATH

LOG = logging.getLogger("spackle.web")
# A Host header: a name or a numeric address, which is group 1, and perhaps a port.
HOST_PATTERN = re.compile(r"(\[[0-9a-f:.%]+\]|[0-9a-z._-]+)(?::\d{1,5})?", re.IGNORECASE)
# Values of Sec-Fetch-Site that are admitted; none: an address that a person typed, or a bookmark.
OWN_SITES = {"same-origin", "none"}
STATUS_PATHS = {"/healthz", "/readyz"}  # tell everybody whether the server runs, and no more
# What a page of an admitted other site may do (CORS), and what it may read of an answer's headers.
PREFLIGHT_HEADERS = {
    "Access-Control-Allow-Methods": "GET, POST, DELETE",
    "Access-Control-Allow-Headers": "Authorization, Content-Type, Idempotency-Key",
    "Access-Control-Max-Age": "600",  # seconds that a browser may remember this
}
PAGE_HEADERS = {
    "Access-Control-Expose-Headers": "Location, Retry-After, Content-Disposition",
    "Vary": "Origin",
}
PREFLIGHT = "spackle.preflight"  # marks a browser's question about what it may send
OUTER_ROOT = "spackle.outer_root"  # the root path of an app, without the token, in the scope
STRANGER = "spackle.stranger"  # marks a request without the token, in its scope
MAX_SEND_S = 20.0  # seconds that a client may take to read a part of an answer
MAX_SILENCE_S = 10.0  # seconds that a client may send nothing of a body
# Bytes a second, slower than the slowest phone: a body that trickles holds a place in the queue.
MIN_BODY_SPEED = 2000.0
MAX_REQUESTS = 448  # answered at a time
MAX_UPLOAD_BYTES = 200_000_000  # of an upload: photo and depth map
# The page loads scripts and styles from this server only and sends nothing elsewhere; no other page
# can frame it.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data: blob:; media-src blob:; worker-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
POLICY_HEADER = "Content-Security-Policy"
SECURITY_HEADERS = {
    "Cache-Control": "no-store",  # a photo is private
    POLICY_HEADER: CONTENT_SECURITY_POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Server": "spackle",  # strangers learn no versions
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Access(NamedTuple):
    """Access rules of a stand-alone server: who may send which request."""

    # A request has it as the first part of the path, or as Bearer; None: no photo is accepted.
    token: str | None
    names: frozenset[str] = frozenset({"localhost"})  # accepted host names
    local: bool = True  # only this machine can connect
    public: PublicAddress = LOCAL_ONLY  # names and proxies outside of this machine
    clients: tuple[Client, ...] = ()  # others with tokens of their own

    @staticmethod
    def for_listener(
        host: str,
        address: str,
        token: str | None,
        public: PublicAddress = LOCAL_ONLY,
        clients: tuple[Client, ...] = (),
    ) -> Access:
        """The rules for a server that listens at `host`, whose numeric address is `address`.

        If other machines can connect, the names by which they call this machine are accepted, too.
        Names of `public` are accepted in any case.
        """
        if is_loopback(address):
            return Access(token, public=public, clients=clients)
        machine = socket.gethostname().lower()
        short_name = machine.partition(".")[0]
        # NAME.local is the name that machines of a home network use without a name server.
        names = frozenset({"localhost", machine, short_name, f"{short_name}.local", host.lower()})
        return Access(token, names, local=False, public=public, clients=clients)

    def authorize(self, scope: Scope, headers: Headers) -> Scope:
        """Check a request, and strip the token from its path.

        Args:
            scope: the request, as ASGI passes it: method, path and others.
            headers: the request's headers.

        Returns:
            The request for the app, whose root path includes the token if the path began with it.
            `clients.client_of` tells whose token it is.

        Raises:
            HTTPException: 403 for the name of another host or the page of another site, 401 without
                the token.
        """
        hosts = self.public.asked_hosts(headers, scope.get("client"))
        page_origin = self.public.admitted_origin(headers)
        check_same_site(headers, hosts, self._is_own_name, self.public.origin, page_origin)

        # Before a browser sends a request from another site, it asks, without a token, if it may.
        is_preflight = "access-control-request-method" in headers and scope["method"] == "OPTIONS"
        if page_origin is not None and is_preflight:
            return {**scope, PREFLIGHT: True}

        # An address of the page holds the token: /TOKEN/viewer.css.
        root = scope["root_path"]  # where another app has mounted this one
        path = scope["path"]
        parts = path.removeprefix(root).split("/")
        first_part = parts[1] if path.count("/") > 1 else ""  # parts[0] is before the first slash
        client = self._holder_of(first_part)
        if client is not None:
            token_root = f"{root}/{first_part}"
            return {**scope, CLIENT_KEY: client, OUTER_ROOT: root, "root_path": token_root}

        # Programs send the token as a header.
        bearer = headers.get("authorization", "").removeprefix("Bearer ")
        client = self._holder_of(bearer)
        if client is not None:
            return {**scope, CLIENT_KEY: client}

        # The request has no valid token. A server that was started without one lets everybody read,
        # but nobody send photos. A server with a token says whether it runs and is ready, and shows
        # a scene to those who have its link.
        if self.token is None:
            if scope["method"] not in ("GET", "HEAD"):
                raise HTTPException(401, "this page takes no photos: it was opened without a token")
        elif path in STATUS_PATHS or path.startswith(f"{SHARED_PATH}/"):
            return {**scope, STRANGER: True}
        else:
            raise HTTPException(401, "this needs the token that the server printed")
        return scope

    def _is_own_name(self, name: str) -> bool:
        """Whether a host name or address, without a port and in lower case, leads to this server.

        Only known names count, because a stranger can make his own host name lead here (DNS
        rebinding). A numeric address always leads to the machine that has it.
        """
        try:
            # A server that only this machine can reach has no address but loopback. Others may have
            # any address.
            return is_loopback(name.strip("[]")) or not self.local
        except ValueError:  # no numeric address
            return name.rstrip(".") in self.names | self.public.names

    @property
    def tokens(self) -> dict[str, str]:
        """All tokens, by the name of the client; the server's own one is the operator's."""
        tokens = {client.name: client.token for client in self.clients}
        return tokens if self.token is None else {OPERATOR: self.token, **tokens}

    def _holder_of(self, word: str) -> str | None:
        """The name of the client whose token a word is, or None if it is no token.

        The comparison takes the same time for every word: it tells a stranger nothing.
        """
        holder = None
        for name, token in self.tokens.items():
            if hmac.compare_digest(word.encode(), token.encode()):
                holder = name
        return holder


def outer_root(scope: Scope) -> str:
    """The root path of the app, without the token that a page's addresses hold."""
    root: str = scope.get(OUTER_ROOT, scope["root_path"])
    return root


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a numeric address; ValueError for a name."""
    without_zone = address.partition("%")[0]  # of IPv6: fe80::1%eth0
    return ipaddress.ip_address(without_zone).is_loopback


def check_same_site(
    headers: Headers,
    hosts: Sequence[str],
    is_own_name: Callable[[str], bool],
    public_origin: str | None,
    page_origin: str | None,
) -> None:
    """Refuse a request that a page of another site has made a browser send; HTTPException 403.

    Args:
        headers: of the request. Browsers set Host, Origin and Sec-Fetch-Site; no page can change
            them. Programs need not send Origin and Sec-Fetch-Site.
        hosts: the values of Host as the browser sent them.
        is_own_name: whether a host name in lower case belongs to this server.
        public_origin: Origin of the server's own page behind a proxy, or None.
        page_origin: Origin of the request, if the user of the server has admitted that other site.
    """
    match = HOST_PATTERN.fullmatch(hosts[0].strip()) if len(hosts) == 1 else None
    if match is None or not is_own_name(match[1].lower()):
        raise HTTPException(
            403, "this server does not have that Host name: whoever runs it can allow the name"
        )

    if page_origin is not None:
        return

    # Through a tunnel, a browser may see this server by https.
    own_host = hosts[0].strip().lower()
    own_origins = {f"http://{own_host}", f"https://{own_host}"}
    if public_origin is not None:
        own_origins.add(public_origin)
    origins = {origin.strip().lower() for origin in headers.getlist("origin")}
    sites = {site.strip().lower() for site in headers.getlist("sec-fetch-site")}
    if not origins <= own_origins or not sites <= OWN_SITES:
        raise HTTPException(403, "the request comes from a page of another site")


class Guard:
    """Middleware that refuses or limits requests, and sets security headers in every answer."""

    def __init__(
        self,
        app: ASGIApp,
        access: Access | None,
        max_bytes: int,
        count_answer: Callable[[str, int], None] | None = None,
    ) -> None:
        """Guard an app.

        Args:
            app: receives the requests that are admitted.
            access: the rules; None admits every request.
            max_bytes: size limit of a request's body.
            count_answer: called with the method and status of each answer; None: nobody counts.
        """
        self.app = app
        self.access = access
        self.max_bytes = max_bytes
        self.count_answer = count_answer
        self.request_count = 0  # of the requests that are being answered

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, if it may be answered.

        As in every ASGI app, `scope` describes the request, `receive` gives its body, and `send`
        takes the answer.
        """
        if scope["type"] == "lifespan":  # the start and the end of the server
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # a WebSocket, which this app does not have
            return

        headers = Headers(scope=scope)
        receive_limited = self._limited(receive)
        send_guarded = GuardedSend(send, self._answer_headers(headers), self._note_answer(scope))

        async def refuse(error: HTTPException) -> None:
            """Answer with an error, unless another answer has begun: then the connection ends."""
            if send_guarded.has_begun:
                raise error
            answer = JSONResponse({"error": error.detail}, error.status_code, error.headers)
            await answer(scope, receive, send_guarded)

        self.request_count += 1
        try:
            self._check_message(headers)
            admitted = scope
            if self.access is not None:
                admitted = self.access.authorize(scope, headers)
            if admitted.get(PREFLIGHT):
                await Response(status_code=204, headers=PREFLIGHT_HEADERS)(
                    scope, receive, send_guarded
                )
                return
            # A body that announces too large a size is refused before it comes.
            self._check_size(int(headers.get("content-length", 0)))
            await self.app(admitted, receive_limited, send_guarded)
        except HTTPException as error:
            await refuse(error)
        except (asyncio.TimeoutError, ClientDisconnect):
            LOG.debug("a client disconnected, or does not read its answer")
        except Exception as error:
            fault = machine_fault(error)
            if fault is None:
                LOG.exception("this went wrong:")
                await refuse(HTTPException(500, REASONS[500][1]))
            else:
                await refuse(no_space(reason_in_a_line(fault)))
        finally:
            self.request_count -= 1

    def _check_message(self, headers: Headers) -> None:
        """HTTPException 400 for a body of two lengths, 503 if too many requests are answered.

        With two lengths, a proxy may take the end of a body for another request.
        """
        if "content-length" in headers and "transfer-encoding" in headers:
            problem = "send either Content-Length or Transfer-Encoding"
            raise HTTPException(400, problem, {"Connection": "close"})
        if self.request_count > MAX_REQUESTS:
            problem = "too many requests are answered: try again later"
            raise HTTPException(503, problem, {"Retry-After": str(RETRY_AFTER_S)})

    def _check_size(self, byte_count: int) -> None:
        """HTTPException 413 if a body has more bytes than allowed."""
        if byte_count > self.max_bytes:
            limit = f"{self.max_bytes / 1e6:g} MB"
            raise HTTPException(413, f"more than {limit}: send a smaller photo")

    def _limited(self, receive: Receive) -> Receive:
        """A `receive` that counts a body's bytes and the time that they take.

        The announced size is not enough, because a body may be longer, or announce none. The
        function raises HTTPException 413 for too long a body, and 408 for one that comes too
        slowly: a client that sends nothing would hold a place in the queue.
        """
        received_bytes = 0
        waited_s = 0.0
        has_ended = False

        async def receive_limited() -> Message:
            nonlocal received_bytes, waited_s, has_ended
            if has_ended:  # what comes now is the end of the connection, at any time
                return await receive()
            allowed_s = MAX_SILENCE_S + received_bytes / MIN_BODY_SPEED
            start = time.monotonic()
            try:
                message = await asyncio.wait_for(
                    receive(), min(MAX_SILENCE_S, allowed_s - waited_s)
                )
            except asyncio.TimeoutError:
                raise HTTPException(408, "the photo arrived too slowly") from None
            waited_s += time.monotonic() - start
            received_bytes += len(message.get("body", b""))
            has_ended = not message.get("more_body", False)
            self._check_size(received_bytes)
            return message

        return receive_limited

    def _answer_headers(self, headers: Headers) -> dict[str, str]:
        """The headers of every answer to a request with these headers."""
        # A browser shows the answer to a page of another site only if it names the site.
        page_origin = None
        if self.access is not None:
            page_origin = self.access.public.admitted_origin(headers)
        if page_origin is None:
            return SECURITY_HEADERS
        return {**SECURITY_HEADERS, "Access-Control-Allow-Origin": page_origin, **PAGE_HEADERS}

    def _note_answer(self, scope: Scope) -> Callable[[int], None]:
        """A function that logs and counts the answer to a request, by its status."""

        def note_answer(status: int) -> None:
            self._log_request(scope, status)
            if self.count_answer is not None:
                self.count_answer(scope["method"], status)

        return note_answer

    def _log_request(self, scope: Scope, status: int) -> None:
        """Log a request and the status of its answer; a token is replaced by "…"."""
        if not LOG.isEnabledFor(logging.DEBUG):  # clients ask for states many times a second
            return
        path = scope["path"]
        for token in () if self.access is None else self.access.tokens.values():
            path = path.replace(token, "…", 1)
        LOG.debug(printable_line(f"{scope['method']} {path} {status}"))


class GuardedSend:
    """The one door through which answers leave: it adds headers to them, and is not patient."""

    def __init__(self, send: Send, headers: dict[str, str], note: Callable[[int], None]) -> None:
        """Send an answer.

        Args:
            send: takes the parts of the answer.
            headers: are added.
            note: called with the status.
        """
        self.has_begun = False
        self._send = send
        self._headers = headers
        self._note = note

    async def __call__(self, message: Message) -> None:
        """Send a part; asyncio.TimeoutError if the client does not read it."""
        if message["type"] == "http.response.start":
            self.has_begun = True
            answer_headers = MutableHeaders(scope=message)
            # A scene's own page brings a policy for its scripts; see `SharedScenes.get_page`.
            policy = answer_headers.get(POLICY_HEADER, CONTENT_SECURITY_POLICY)
            answer_headers.update({**self._headers, POLICY_HEADER: policy})
            self._note(message["status"])
        await asyncio.wait_for(self._send(message), MAX_SEND_S)
