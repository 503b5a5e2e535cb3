"""Run the app on this machine: to show a scene or photo (`show_page`), or for programs.

`serve_programs` and `show_page` are the work of `spackle serve` and `spackle view`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import logging
import os
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path

from fastapi import FastAPI

from spackle.bases.open import open_base
from spackle.bases.settings import AUTO, RGBD, BaseSettings
from spackle.core.photo import check_photo_size, load_photo
from spackle.formats.html import check_has_front
from spackle.formats.scene_files import is_scene_folder, load_scene, scene_suffix
from spackle.results.saved_scene import log_losses, page_name
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.runtime.progress import Reporter, catch_stop_signals
from spackle.runtime.worker_options import gpu_worker_count
from spackle.scene import Scene
from spackle.views import PathOptions
from spackle.web.app import create_app, make_server
from spackle.web.callbacks import CallbackSender
from spackle.web.clients import Client
from spackle.web.decoding import check_photo
from spackle.web.guard import Access
from spackle.web.jobs import LOG, Jobs, RetentionLimits
from spackle.web.public_address import LOCAL_ONLY, PublicAddress
from spackle.web.work import PREVIEW, SceneWork

# Hosts at which a server accepts connections from everywhere, and the address on this machine.
LOOPBACK_OF_ANY_HOST = {"0.0.0.0": "127.0.0.1", "::": "::1"}
MAX_WAITING_CONNECTIONS = 128
# An address that is reserved for documentation, and any port: nothing is ever sent there.
PROBED_ADDRESS = ("192.0.2.1", 9)
SCREEN_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")  # set on Linux if there is a screen


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServerAddress:
    """Where the server listens, and who may use it."""

    host: str
    port: int  # 0: any free port
    token: str | None  # the secret that a client must know; None: everybody on this machine may
    public: PublicAddress = LOCAL_ONLY  # names outside of this machine, and proxies
    clients: tuple[Client, ...] = ()  # others with tokens and limits of their own
    callback_hosts: tuple[str, ...] = ()  # hosts that may be told that scenes are done

    def url_at(self, host: str, port: int) -> str:
        """The page's address, with the token, at a host and the port that was found."""
        bracketed_host = f"[{host}]" if ":" in host else host  # IPv6
        path = f"{self.token}/" if self.token else ""
        return f"http://{bracketed_host}:{port}/{path}"

    @property
    def public_url(self) -> str | None:
        """The page's address behind a proxy, with the token, if the user has given one."""
        if self.public.url is None:
            return None
        path = f"{self.token}/" if self.token else ""
        return f"{self.public.url.rstrip('/')}/{path}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of `spackle view`.

    Depth, calibration and focal length belong to the scene or photo that is shown first. Disparity,
    frame and kind of depth also apply to all photos that the page sends.
    """

    base: BaseSettings
    disparity: float | None = None
    focal_px: float | None = None
    fov: float | None = None
    keep_frame: bool = False
    opens_browser: bool = True


def show_page(
    target: Path | None, options: ViewOptions, address: ServerAddress, reporter: Reporter
) -> None:
    """Show a scene or a photo, or an empty page, until the user stops the server.

    Then all scenes are deleted.

    Raises:
        InputError: the target is neither photo nor scene, or an option cannot be used.
    """
    PathOptions(disparity=options.disparity).check()
    title = "Spackle"
    if target is not None:
        with reporter.stage("load"):
            title = _check_target(target, options, reporter)

    # A depth map belongs to the first photo alone. Photos that the page sends later have none, and
    # so cannot use the base "rgbd", which needs one.
    base_name = AUTO if options.base.name == RGBD else options.base.name
    base_of_sent_photos = dataclasses.replace(
        options.base, name=base_name, depth=None, depth_kind="auto", depth_unit=None
    )
    base_of_sent_photos.check()
    default_options = {
        "disparity": options.disparity,
        "keep_frame": options.keep_frame,
        "depth_kind": options.base.depth_kind,
        "depth_unit": options.base.depth_unit,
    }
    work = SceneWork(base_of_sent_photos, default_options, reporter.verbose)

    with (
        tempfile.TemporaryDirectory(prefix="spackle-view-", ignore_cleanup_errors=True) as folder,
        run_server(
            folder=Path(folder),
            work=work,
            workers=1,  # one photo at a time, because one person watches
            limits=RetentionLimits(),
            address=address,
            reporter=reporter,
        ) as (jobs, urls),
    ):
        # A scene is shown at once; all else needs what the warm-up prepares.
        is_scene = target is not None and scene_suffix(target) is not None
        if not is_scene:
            jobs.warm_up()
        if target is not None:
            # The page shows the scene whose id follows the # in its address.
            job_id = _add_target(jobs, target, title, options)
            urls = [f"{url}#{job_id}" for url in urls]
        if is_scene:
            jobs.warm_up()
        announce(title, urls, address, reporter, opens_browser=options.opens_browser)


def _check_target(target: Path, options: ViewOptions, reporter: Reporter) -> str:
    """Check that a scene or photo can be shown; returns what the page calls it.

    InputError if the scene, the photo or its depth cannot be read.
    """
    if not is_scene_folder(target):
        check_file(target, "photo or scene")
    settings = options.base
    settings.check()
    if scene_suffix(target):
        if settings.depth is not None:
            raise InputError(
                f"`depth` {settings.depth}: {target.name} is a scene already: leave the option out"
            )
        with as_input_error(
            target, "cannot be viewed: {reason}: give the lens with `fov`", ValueError
        ):
            loaded = load_scene(target)
            scene = Scene.of_file(loaded, focal_px=options.focal_px, fov=options.fov)
            check_has_front(target.name, scene.base)
        log_losses(loaded, reporter)
        return page_name(target)

    # A depth map belongs to the whole photo, so its frame must not be cropped.
    keep_frame = options.keep_frame or settings.depth is not None
    photo = load_photo(target, keep_frame=keep_frame, focal_px=options.focal_px, fov=options.fov)
    check_photo_size(photo.width, photo.height, photo.path)
    if settings.checkpoint is not None:
        check_file(settings.checkpoint, "file of weights")
    if settings.depth is not None:
        open_base(settings).load(photo)  # fails if the depth map does not fit the photo
    return target.name


def _add_target(jobs: Jobs, target: Path, title: str, options: ViewOptions) -> str:
    """Queue the scene or photo that is shown first; returns the id of its job."""
    with jobs.reserve_place() as job_folder:
        if scene_suffix(target) is None:
            check_photo(target, title, job_folder / PREVIEW)
        # Absolute paths tell a job that the files are the user's own, which it must not delete.
        depth_file = None
        if options.base.depth is not None:
            depth_file = os.path.abspath(str(options.base.depth))
        job = jobs.add(
            job_folder,
            name=title,
            source=os.path.abspath(target),
            depth=depth_file,
            options={
                "base": options.base.name,
                "focal_px": options.focal_px,
                "fov": options.fov,
                "files": [],  # the page asks for further files when the user wants them
            },
        )
    return job.id


def serve_programs(
    folder: Path,
    work: SceneWork,
    workers: int | None,
    limits: RetentionLimits,
    address: ServerAddress,
    reporter: Reporter,
) -> None:
    """Complete photos for programs until the user stops the server.

    Args:
        folder: the folder of photos and scenes.
        work: what a worker process does with a photo.
        workers: the number of worker processes; None: one for each GPU, or one.
        limits: how long and how many scenes are kept.
        address: where the server listens.
        reporter: gets messages and results.

    Raises:
        InputError: an option cannot be used.
    """
    work.base.check()
    if workers is None:
        workers = gpu_worker_count(work.base.device)
    with run_server(folder, work, workers, limits, address, reporter) as (jobs, urls):
        # Photos that an earlier server left unfinished come first, and prepare the process.
        if all(job.ended is not None for job in jobs.by_id.values()):
            jobs.warm_up()
        reporter.log(
            f"token: {address.token} (send it as `Authorization: Bearer TOKEN`, "
            "or use the address, which has it)"
        )
        announce("HTTP interface, and its page", urls, address, reporter, opens_browser=False)


@contextlib.contextmanager
def run_server(
    folder: Path,
    work: SceneWork,
    workers: int,
    limits: RetentionLimits,
    address: ServerAddress,
    reporter: Reporter,
) -> Iterator[tuple[Jobs, list[str]]]:
    """Yield the app's jobs and the page's addresses; then answer requests until Ctrl-C or SIGTERM.

    Args:
        folder: the folder of photos and scenes.
        work: what a worker process does with a photo.
        workers: the number of worker processes.
        limits: how long and how many scenes are kept.
        address: where the server listens, and the token that a client must know.
        reporter: gets messages.

    Raises:
        InputError: the server cannot listen at this address, or other machines could connect
            without a token.
    """
    with (
        # The server is one process, which alone gets Ctrl-C: so a second Ctrl-C, by somebody who
        # does not want to wait, may end it at once.
        catch_stop_signals(single_process=True) as is_stopping,
        open_listener(address.host, address.port) as listener,
        log_jobs_to(reporter),
    ):
        bound_host, port = listener.getsockname()[:2]
        access = Access.for_listener(
            address.host, bound_host, address.token, address.public, address.clients
        )
        if not access.local and address.token is None:
            raise InputError(
                f"`host` {address.host}: other machines can connect: leave `no_token` out"
            )

        # The page's address on this machine comes first, then the one for other machines.
        hosts = [LOOPBACK_OF_ANY_HOST.get(bound_host, bound_host)]
        if not access.local:
            hosts.append(address_in_network(address.host))
        urls = [address.url_at(host, port) for host in hosts]

        app = create_app(
            folder,
            work,
            workers=workers,
            keep=limits,
            access=access,
            callbacks=CallbackSender(address.callback_hosts, access.tokens),
        )
        with contextlib.closing(app.state.jobs) as jobs:
            # The socket accepts connections already, so the caller may announce the page now.
            yield jobs, urls
            # A signal may have come meanwhile.
            if not is_stopping():
                answer_requests(app, listener)


def answer_requests(app: FastAPI, listener: socket.socket) -> None:
    """Answer what comes to a socket until Ctrl-C or SIGTERM."""
    # Now and then, Python looks through all objects for those that nothing leads to any more. The
    # imported modules have 250,000, which takes 0.2 seconds, in which nobody would be answered.
    gc.freeze()
    try:
        make_server(app).run(sockets=[listener])
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def log_jobs_to(reporter: Reporter) -> Iterator[None]:
    """Log jobs to the terminal during the block, and requests if the reporter is verbose."""

    class ReporterHandler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            reporter.log(self.format(record))

    handler = ReporterHandler()
    LOG.addHandler(handler)
    LOG.setLevel(logging.DEBUG if reporter.verbose else logging.INFO)
    LOG.propagate = False
    try:
        yield
    finally:
        LOG.removeHandler(handler)


def open_listener(host: str, port: int) -> socket.socket:
    """A socket that listens for connections; InputError if the address cannot be used."""
    with as_input_error(
        f"`host` {host}, `port` {port}",
        "cannot listen there: {reason}: give another one",
        OSError,
        UnicodeError,
    ):
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        accepts_both_protocols = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        try:
            listener = socket.create_server(
                (host, port),
                family=family,
                backlog=MAX_WAITING_CONNECTIONS,
                dualstack_ipv6=accepts_both_protocols,
            )
        except OSError as error:
            # The error's own text names the address, which the message has already.
            raise OSError(error.errno, os.strerror(error.errno or 0)) from error
        # A socket made from the file number knows its protocol. Without it asyncio does not set
        # TCP_NODELAY, and answers are delayed by 40 ms.
        return socket.socket(fileno=listener.detach())


def announce(
    name: str,
    urls: list[str],
    address: ServerAddress,
    reporter: Reporter,
    *,
    opens_browser: bool,
) -> None:
    """Print the page's addresses, and open a browser.

    Args:
        name: what the page shows.
        urls: the address on this machine, and the address from others if they can connect.
        address: where the server listens, for the warning that others can connect.
        reporter: gets the lines.
        opens_browser: whether to open a browser, if there is a screen.
    """
    if len(urls) > 1:
        reporter.log(
            f"warning: `host` {address.host} admits everybody in the network who has the token; "
            "the connection is not encrypted"
        )
        reporter.log(f"{name}: from other machines {urls[1]}")
    if address.public_url is not None:
        reporter.log(f"{name}: through the proxy {address.public_url}")
    reporter.log(f"{name}: {urls[0]} (Ctrl-C ends)")
    reporter.result({"url": address.public_url or urls[0]})
    if not opens_browser:
        return

    # Without a screen Linux would open a text browser, which takes over the terminal.
    has_screen = any(os.environ.get(variable) for variable in SCREEN_VARIABLES)
    if sys.platform.startswith("linux") and not has_screen:
        reporter.log(
            "this machine has no screen: open the page on another machine, through `ssh -L`"
        )
        return
    # Some browsers return only when they are closed, so a thread waits for them.
    threading.Thread(target=webbrowser.open, args=(urls[0],), daemon=True, name="browser").start()


def address_in_network(host: str) -> str:
    """The address at which other machines reach a server that listens at `host`."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        # Connecting a UDP socket sends nothing, whatever the other address is, but chooses the
        # address of this machine from which packets to the network would be sent.
        probe.connect(PROBED_ADDRESS)
        return str(probe.getsockname()[0])
    return socket.gethostname()  # no network
