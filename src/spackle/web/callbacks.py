"""Callbacks: a client's server hears when its photo's scene is done or has failed.

The messages are signed as Standard Webhooks says (https://www.standardwebhooks.com), with the
client's token as the secret. They go only to hosts that whoever runs this server has named.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import http.client
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

from starlette.exceptions import HTTPException

from spackle.runtime.errors import InputError, printable_line, reason_in_a_line
from spackle.web.public_address import USUAL_PORTS

LOG = logging.getLogger("spackle.web")
# Seconds before each attempt. A host that restarts is back within the first ones, a host that has
# to be mended within the last.
DELAYS_S = (0.0, 5.0, 30.0, 300.0, 1800.0)
TIMEOUT_S = 10.0  # for the connection, and for each part of an answer
SENDER_COUNT = 4  # messages at a time, so that one slow host does not hold up all others
MAX_URL_CHARACTERS = 2000


class Delivery(NamedTuple):
    """A message that is to be sent."""

    url: str
    client: str  # who has sent the photo, and whose token signs the message
    due: float  # time.monotonic() of the next attempt
    attempt: int  # 0: the first one


class CallbackSender:
    """Sends the states of ended jobs to the addresses that their clients have given."""

    def __init__(self, hosts: Sequence[str], tokens: Mapping[str, str]) -> None:
        """Prepare to send; nothing is sent before `start`.

        Args:
            hosts: the only hosts that are called: "hooks.example.com" or "hooks.example.com:8443"
                by https, "http://10.0.0.5:9000" without encryption. InputError for anything else.
            tokens: sign the messages, by the names of the clients.
        """
        self._origins = frozenset(_allowed_origin(host) for host in hosts)
        self._tokens = dict(tokens)
        self._deliveries: dict[str, Delivery] = {}  # by the id of a job
        self._changed = threading.Condition()  # also the lock of the two fields around it
        self._is_closed = False

    def check(self, url: object) -> str | None:
        """The address in a form's field `callback_url`, or None if the field is empty or missing.

        HTTPException 422 for what is no address, or an address on another host.
        """
        if url is None or url == "":
            return None
        try:
            if not isinstance(url, str) or not url.isascii() or not url.isprintable():
                raise ValueError("no address")
            if len(url) > MAX_URL_CHARACTERS or " " in url:
                raise ValueError("no address")
            origin = _origin(urlsplit(url))
        except ValueError:
            raise HTTPException(
                422, "callback_url: no address: give one such as https://hooks.example.com/done"
            ) from None
        if origin not in self._origins:
            raise HTTPException(
                422,
                "callback_url: this server may not call that host: whoever runs it can allow the "
                "host",
            )
        return url

    def start(self, describe: Callable[[str], bytes | None], forget: Callable[[str], None]) -> None:
        """Start the threads that send what `schedule` gets.

        Args:
            describe: returns the state of the job with an id, as JSON; None if it was deleted.
            forget: called with the id of a job whose message has arrived or was given up.
        """
        for _ in range(SENDER_COUNT if self._origins else 0):
            threading.Thread(target=self._send_due, args=(describe, forget), daemon=True).start()

    def schedule(self, id: str, url: str, client: str) -> None:
        """Send the state of a client's job to an address, as soon as a thread is free.

        Args:
            id: of the job.
            url: the address.
            client: the name of the client.
        """
        self._put(id, Delivery(url, client, time.monotonic() + DELAYS_S[0], 0))

    def close(self) -> None:
        """Send nothing more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _put(self, id: str, delivery: Delivery) -> None:
        """Add or replace the message about a job."""
        with self._changed:
            self._deliveries[id] = delivery
            self._changed.notify()

    def _take_due(self) -> tuple[str, Delivery] | None:
        """Wait for a message that is due, and take it; None at the end."""
        with self._changed:
            while not self._is_closed:
                wait_s: float | None = None  # until another thread adds a message
                if self._deliveries:
                    id = min(self._deliveries, key=lambda id: self._deliveries[id].due)
                    wait_s = self._deliveries[id].due - time.monotonic()
                    if wait_s <= 0:
                        return id, self._deliveries.pop(id)
                self._changed.wait(wait_s)
        return None

    def _send_due(
        self, describe: Callable[[str], bytes | None], forget: Callable[[str], None]
    ) -> None:
        """Send one message after the other until the end; the arguments are those of `start`."""
        taken = self._take_due()
        while taken is not None:
            id, delivery = taken
            self._deliver(id, delivery, describe(id), forget)
            taken = self._take_due()

    def _deliver(
        self, id: str, delivery: Delivery, body: bytes | None, forget: Callable[[str], None]
    ) -> None:
        """Send a message, and put it back for another attempt if it did not arrive.

        Args:
            id: of the job.
            delivery: the message's address and number of attempts.
            body: the job's state, or None if the job was deleted: then nothing is sent.
            forget: called with the id if no further attempt follows.
        """
        if body is None:
            return
        problem = self._send(id, delivery, body)
        next_attempt = delivery.attempt + 1
        if problem is not None and next_attempt < len(DELAYS_S):
            due = time.monotonic() + DELAYS_S[next_attempt]
            self._put(id, delivery._replace(due=due, attempt=next_attempt))
            return
        if problem is not None:
            LOG.error(printable_line(f"error: callback about {id} given up: {problem}"))
        forget(id)

    def _send(self, id: str, delivery: Delivery, body: bytes) -> str | None:
        """Send a message once; returns None if it arrived, or why it did not.

        Only an answer of 2xx counts. A redirect is not followed, because it may lead to a host that
        nobody has allowed.
        """
        token = self._tokens.get(delivery.client)
        if token is None:
            return f"there is no client {delivery.client} any more"
        parts = urlsplit(delivery.url)
        secure = parts.scheme == "https"
        connection_type = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = connection_type(str(parts.hostname), parts.port, timeout=TIMEOUT_S)
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        try:
            connection.request("POST", target, body, _headers(id, body, token))
            status = connection.getresponse().status
        except (OSError, http.client.HTTPException) as error:
            return reason_in_a_line(error)
        finally:
            connection.close()
        return None if 200 <= status < 300 else f"the answer was {status}"


def _headers(id: str, body: bytes, token: str) -> dict[str, str]:
    """The headers of a message, with its signature: HMAC-SHA256 of "ID.SECONDS.BODY"."""
    seconds = str(int(time.time()))  # since 1970; receivers refuse old messages
    signed = b".".join((id.encode(), seconds.encode(), body))
    signature = base64.b64encode(hmac.digest(token.encode(), signed, hashlib.sha256)).decode()
    return {
        "Content-Type": "application/json",
        "User-Agent": "spackle",
        "Webhook-Id": id,
        "Webhook-Timestamp": seconds,
        "Webhook-Signature": f"v1,{signature}",  # v1: the version of the way to sign
    }


def _origin(parts: SplitResult) -> tuple[str, str, int]:
    """Scheme, host name and port of an address; ValueError if it leads to no host by HTTP."""
    port = parts.port  # ValueError for a port that is no number
    if parts.scheme not in USUAL_PORTS or not parts.hostname or parts.username is not None:
        raise ValueError("no address of a host")
    return parts.scheme, parts.hostname, USUAL_PORTS[parts.scheme] if port is None else port


def _allowed_origin(host: str) -> tuple[str, str, int]:
    """Scheme, host name and port of a host that may be called; InputError if it is no host."""
    address = host if "://" in host else f"https://{host}"
    try:
        parts = urlsplit(address)
        if parts.path not in ("", "/") or parts.query or parts.fragment or "*" in address:
            raise ValueError("more than a host")
        return _origin(parts)
    except ValueError as error:
        raise InputError(
            f"`callback_host` {host}: no host: give one such as hooks.example.com, or "
            "http://10.0.0.5:9000 for one without encryption"
        ) from error
