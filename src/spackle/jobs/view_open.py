"""Saying where the page is, to people and to a browser."""

from __future__ import annotations

import os
import socket
import sys
import threading
import webbrowser

from spackle.progress import Reporter
from spackle.viewer.server import ViewerServer

OPEN_TO_ALL = (
    "warning: everybody in the network can see this photo at --host {host}, send photos of their own and use this "
    "machine to complete them; the connection is not encrypted"
)
ELSEWHERE = ("192.0.2.1", 9)  # an address of documentation: asking for the way there sends nothing


def announce(server: ViewerServer, name: str, reporter: Reporter, *, browser: bool) -> None:
    """Say where to look, warn where strangers can look too, and open a browser where there is one."""
    if not server.local:
        reporter.say(OPEN_TO_ALL.format(host=server.host))
        reporter.say(f"{name}: from other machines {server.url_at(address_in_network(server.host))}")
    reporter.say(f"{name}: {server.url} (Ctrl-C ends)")
    reporter.result({"url": server.url})
    if browser and not has_screen():
        reporter.say("no screen here: open that page yourself; from another machine through `ssh -L`")
    elif browser:
        # Some browsers come back only when they are closed.
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True, name="browser").start()


def has_screen() -> bool:
    """Whether a browser would have a window; one of text would take the terminal away."""
    if not sys.platform.startswith("linux"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))


def address_in_network(host: str) -> str:
    """The address by which others reach this machine, listening at `host`."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(ELSEWHERE)
            return str(probe.getsockname()[0])
    except OSError:  # no network
        return socket.gethostname()
