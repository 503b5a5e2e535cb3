"""`spackle view` and `spackle serve`: run the app on this machine, to show a scene or photo, or for programs."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from spackle.bases.open import open_base
from spackle.bases.settings import AUTO, RGBD, BaseSettings
from spackle.cli.saved_scene import page_name
from spackle.core.photo import check_photo_size, load_photo
from spackle.formats.scene_files import scene_suffix
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.runtime.progress import Reporter, catch_stop_signals
from spackle.scene import Scene
from spackle.views import PathOptions
from spackle.web.app import create_app, make_server
from spackle.web.guard import Access
from spackle.web.jobs import LOG, Jobs, RetentionLimits
from spackle.web.work import PREVIEW, SceneWork, check_photo

LOOPBACK = "127.0.0.1"


class Place(NamedTuple):
    """Address of the server."""

    host: str
    port: int  # 0: any free port
    token: str | None
    browser: bool  # whether to open the page in a browser


def view(
    target: Path | None,
    settings: BaseSettings,
    usual: Mapping[str, object],
    lens: Mapping[str, float | None],
    place: Place,
    reporter: Reporter,
) -> None:
    """Show a scene or a photo, or an empty page, until the user stops the server; then delete all scenes.

    Depth, calibration and `lens` (`focal_px` and `fov`) belong to the target; `usual` (disparity, keep_frame,
    depth_kind) applies to all photos that the page sends.

    Raises:
        InputError: the target is neither photo nor scene, or an option cannot be used.
    """
    PathOptions(disparity=usual["disparity"]).check()  # type: ignore[arg-type]
    name = "Spackle"
    if target is not None:
        with reporter.stage("load"):
            name = _checked(target, settings, lens, bool(usual["keep_frame"]))
    base = AUTO if settings.name == RGBD else settings.name
    others = dataclasses.replace(settings, depth=None, depth_kind="auto", name=base)
    others.check()
    with tempfile.TemporaryDirectory(prefix="spackle-view-", ignore_cleanup_errors=True) as folder:
        work = SceneWork(others, usual, reporter.verbose)
        with listening(Path(folder), work, 1, RetentionLimits(), place, reporter) as (jobs, urls):
            if target is not None:
                with jobs.reserve_place() as new:
                    if scene_suffix(target) is None:
                        check_photo(target, name, new / PREVIEW)
                    depth = None if settings.depth is None else os.path.abspath(str(settings.depth))
                    options: dict[str, object] = {"base": settings.name, **lens, "files": []}
                    job = jobs.add(new, name, os.path.abspath(target), depth, options)
                urls = [f"{url}#{job.id}" for url in urls]
            announce(name, urls, place, reporter)


def _checked(
    target: Path, settings: BaseSettings, lens: Mapping[str, float | None], keep_frame: bool
) -> str:
    """The name of a photo or scene on the page; InputError if the target, or its depth, cannot be read."""
    check_file(target, "photo or scene")
    settings.check()
    if scene_suffix(target):
        if settings.depth is not None:
            raise InputError(
                f"--depth {settings.depth}: {target.name} is a scene already: leave the option out"
            )
        with as_input_error(
            target, "cannot be viewed: {reason}: give the lens with --fov", ValueError
        ):
            Scene.load(target, **lens).page(target.name)
        return page_name(target)
    photo = load_photo(target, keep_frame=keep_frame or settings.depth is not None, **lens)
    check_photo_size(photo.width, photo.height, photo.path)
    if settings.checkpoint is not None:
        check_file(settings.checkpoint, "file of weights")
    if settings.depth is not None:
        open_base(settings).load(photo)
    return target.name


def serve(
    folder: Path,
    work: SceneWork,
    workers: int,
    keep: RetentionLimits,
    place: Place,
    reporter: Reporter,
) -> None:
    """Complete photos for programs until the user stops the server; InputError for an option that cannot be used."""
    work.base.check()
    with listening(folder, work, workers, keep, place, reporter) as (_, urls):
        reporter.log(
            f"token: {place.token} (send it as `Authorization: Bearer TOKEN`, or use the address, which has it)"
        )
        announce("HTTP interface, and its page", urls, place, reporter)


@contextlib.contextmanager
def listening(
    folder: Path,
    work: SceneWork,
    workers: int,
    keep: RetentionLimits,
    place: Place,
    reporter: Reporter,
) -> Iterator[tuple[Jobs, list[str]]]:
    """Yield the app's jobs and the page's addresses; after the block, answer requests until Ctrl-C or SIGTERM."""
    with (
        catch_stop_signals(single_process=True) as stopped,
        listener_at(place.host, place.port) as listener,
        logged_to(reporter),
    ):
        address, port = listener.getsockname()[:2]
        access = Access.for_listener(place.host, address, place.token)
        if not access.local and place.token is None:
            raise InputError(
                f"--host {place.host}: other machines can connect: leave --no-token out"
            )
        app = create_app(folder, work, workers=workers, keep=keep, access=access)
        here = {"0.0.0.0": LOOPBACK, "::": "::1"}.get(address, address)
        addresses = [here] if access.local else [here, address_in_network(place.host)]
        token = f"{place.token}/" if place.token else ""
        with contextlib.closing(app.state.jobs) as jobs:
            yield jobs, [f"http://{f'[{a}]' if ':' in a else a}:{port}/{token}" for a in addresses]
            if not stopped():
                make_server(app).run(sockets=[listener])


@contextlib.contextmanager
def logged_to(reporter: Reporter) -> Iterator[None]:
    """Log jobs to the terminal, and requests if `verbose`."""
    handler = logging.Handler()
    handler.emit = lambda record: reporter.log(handler.format(record))  # type: ignore[method-assign]
    LOG.addHandler(handler)
    LOG.setLevel(logging.DEBUG if reporter.verbose else logging.INFO)
    LOG.propagate = False
    try:
        yield
    finally:
        LOG.removeHandler(handler)


def listener_at(host: str, port: int) -> socket.socket:
    """A listening socket; InputError if the address cannot be used."""
    with as_input_error(
        f"--host {host}, --port {port}",
        "cannot listen there: {reason}: give another one",
        OSError,
        UnicodeError,
    ):
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        try:
            listener = socket.create_server(
                (host, port), family=family, backlog=128, dualstack_ipv6=both
            )
        except OSError as error:  # whose text names the address, too
            raise OSError(error.errno, os.strerror(error.errno or 0)) from error
        # Finds the protocol, without which asyncio would not avoid delays of 40 ms (TCP_NODELAY).
        return socket.socket(fileno=listener.detach())


def announce(name: str, urls: list[str], place: Place, reporter: Reporter) -> None:
    """Print the page's addresses, warn if other machines can connect, and open a browser if there is a screen."""
    if len(urls) > 1:
        reporter.log(
            f"warning: --host {place.host} admits everybody in the network who has the token; the connection is not "
            "encrypted"
        )
        reporter.log(f"{name}: from other machines {urls[1]}")
    reporter.log(f"{name}: {urls[0]} (Ctrl-C ends)")
    reporter.result({"url": urls[0]})
    # A text browser would take over the terminal.
    screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if place.browser and sys.platform.startswith("linux") and not screen:
        reporter.log(
            "this machine has no screen: open the page on another machine, through `ssh -L`"
        )
    elif place.browser:
        # Some browsers return only when they are closed.
        threading.Thread(
            target=webbrowser.open, args=(urls[0],), daemon=True, name="browser"
        ).start()


def address_in_network(host: str) -> str:
    """The address at which other machines reach a server that listens at `host`."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # reserved for documentation; a UDP connect sends nothing
        return str(probe.getsockname()[0])
    return socket.gethostname()  # no network
