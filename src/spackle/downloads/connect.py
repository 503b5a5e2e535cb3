"""A connection to a web server, or one line that says why there is none."""

from __future__ import annotations

import socket
import ssl
from email.message import Message
from http.client import HTTPException, HTTPResponse, InvalidURL, responses
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from spackle.errors import InputError, reason_in_a_line

TIMEOUT = 30.0  # seconds without a byte


class Dropped(Exception):
    """No connection, or no longer; `begun`: the server had begun to send the file."""

    def __init__(self, reason: str, begun: bool) -> None:
        super().__init__(reason)
        self.begun = begun


class Changed(Exception):
    """The server no longer has the file of which the rest was asked for."""


def check_url(url: str) -> None:
    """InputError for anything but http:// and https://, such as file://, and for a password in it."""
    try:
        parts = urlsplit(url)
        host = parts.hostname if parts.port != 0 else None  # a port that is no number is a ValueError
        good = parts.scheme in ("http", "https") and bool(host) and url.isprintable() and " " not in url
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"{_shown(url)}: not an address to download from: give one that begins with https:// or http://"
        )
    if "@" in parts.netloc:
        raise InputError(
            f"an address at {host} with a user name or password in it: spackle logs in nowhere (nor by ~/.netrc): "
            "give an address that works without"
        )


def _shown(url: str) -> str:
    """An address for a message; one that is none may hold a password all the same, where nobody can tell."""
    return "an address (not shown, its @ may follow a password)" if "@" in url else repr(url)


def connect(url: str, headers: dict[str, str]) -> HTTPResponse:
    """Send a request, through the proxies of the environment (https_proxy, no_proxy), and follow redirects.

    Raises:
        Dropped: the server cannot be reached, or not now.
        Changed: it has no bytes in the Range that the headers name.
        InputError: it does not give the file.
    """
    request = Request(url, headers={"User-Agent": "spackle", "Accept-Encoding": "identity", **headers})
    try:
        response: HTTPResponse = build_opener(_SafeRedirects).open(request, timeout=TIMEOUT)
        return response
    except InputError:
        raise
    except HTTPError as error:
        with error:
            status = f"HTTP {error.code} {responses.get(error.code, '')}".rstrip()
        if error.code == 416 and request.has_header("Range"):
            raise Changed from error
        if error.code >= 500 or error.code == 429:
            raise Dropped(f"the server answers {status}: try again later", begun=False) from error
        raise InputError(f"{url}: the server answers {status}: check the address, or give another") from error
    except (InvalidURL, ValueError) as error:  # a port that is no number, a space
        raise InputError(f"{url!r}: not an address to download from: {error}") from error
    except (OSError, HTTPException) as error:
        raise Dropped(reason_of(error), begun=False) from error


class _SafeRedirects(HTTPRedirectHandler):
    """Follows redirects, but not from https to http, and to nothing that we would not take as an address."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Message, newurl: str
    ) -> Request | None:
        if urlsplit(newurl).scheme not in ("https", urlsplit(req.full_url).scheme):
            fp.close()
            raise InputError(
                f"{req.full_url}: the server sends on to {_shown(newurl)}, which is not https: give another address"
            )
        try:
            check_url(newurl)
        except InputError as error:
            fp.close()
            raise InputError(f"{req.full_url}: the server sends on to {error}") from error
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]


def reason_of(error: Exception) -> str:
    """Why there is no connection, and what to do."""
    cause = error.reason if isinstance(error, URLError) else error
    if isinstance(cause, socket.gaierror):
        return "the server's name is not known here: check that you are online, and https_proxy if you need a proxy"
    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"the server's certificate is not trusted ({cause.verify_message}): check the clock and SSL_CERT_FILE"
    if isinstance(cause, TimeoutError):
        return f"no answer within {TIMEOUT:g} seconds: check the connection and try again"
    return f"no connection ({reason_in_a_line(cause)}): check the network and try again"
