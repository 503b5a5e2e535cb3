"""Who may ask: a page of ours, under a name of ours.

A page of a stranger can make a browser send requests to this machine, and by DNS rebinding even under the stranger's
own name. Such a request gives itself away by its Host, its Origin or its Sec-Fetch-Site.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Collection
from email.message import Message

HOST = re.compile(r"(\[[0-9a-f:.%]+\]|[0-9a-z._-]+)(?::\d{1,5})?", re.IGNORECASE)
OWN_SITES = ("same-origin", "none")  # none: typed by a person, or a bookmark

# The page has its scripts and styles from us alone, sends nothing elsewhere and stands in no other page's frame.
CONTENT_POLICY = "; ".join(
    [
        *("default-src 'none'", "script-src 'self' 'wasm-unsafe-eval'", "style-src 'self'"),
        *("connect-src 'self'", "img-src 'self' data: blob:", "media-src blob:", "worker-src 'self' blob:"),
        *("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"),
    ]
)
HEADERS = {
    "Cache-Control": "no-store",  # a photo is private; and the next viewer has other scenes under the same paths
    "Content-Security-Policy": CONTENT_POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a numeric address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def own_names(host: str, address: str) -> frozenset[str]:
    """Host names, besides numeric addresses, under which a server at `host` (numeric: `address`) may be asked."""
    names = {"localhost"}
    if not is_loopback(address):
        machine = socket.gethostname().lower()
        names |= {machine, machine.partition(".")[0], f"{machine.partition('.')[0]}.local", host.lower()}
    return frozenset(names)


def refusal(headers: Message, names: Collection[str], *, local: bool) -> str | None:
    """Why a request is not for us, or None.

    Args:
        headers: of the request.
        names: see `own_names`. Numeric addresses need not be among them, for they cannot be rebound; the port may be
            any, for `ssh -L` gives another.
        local: whether the server is for this machine alone; then numeric addresses of others are refused too.
    """
    hosts = headers.get_all("Host", [])
    match = HOST.fullmatch(hosts[0].strip()) if len(hosts) == 1 else None
    if match is None or not _is_ours(match[1].lower(), names, local):
        return "this server does not go by that Host name"
    ours = {f"{scheme}://{hosts[0].strip().lower()}" for scheme in ("http", "https")}  # https: by a tunnel
    if not {origin.strip().lower() for origin in headers.get_all("Origin", [])} <= ours:
        return "asked by a page of another Origin"
    if any(site.strip().lower() not in OWN_SITES for site in headers.get_all("Sec-Fetch-Site", [])):
        return "asked by a page of another site"
    return None


def _is_ours(name: str, names: Collection[str], local: bool) -> bool:
    try:
        address = ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return name.rstrip(".") in names
    return address.is_loopback or not local
