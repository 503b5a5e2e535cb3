"""`spackle view`: a scene, or a photo that becomes one, on a page of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from spackle.bases.lite import LiteBase
from spackle.bases.settings import AUTO, ROUGH, BaseSettings
from spackle.cli.saved_scene import page_of
from spackle.errors import InputError, check_name
from spackle.files import check_file
from spackle.formats.scene_files import SceneFile, encoder_of
from spackle.image import Photo, load_photo
from spackle.pipeline import Options, Pipeline
from spackle.progress import Reporter, Step, asked_to_stop
from spackle.scene import Scene
from spackle.views import PathOptions
from spackle.web import PageScene, page_files
from spackle.web.handler import Tell
from spackle.web.server import ViewerServer

DOWNLOADS = (".ply", ".spz", ".sog")  # of a scene that the page shows
WRITTEN_ONLY = (".spz", ".splat", ".sog", ".glb", ".html")


def view_page(
    target: Path,
    uploads: Uploads,
    lens: Mapping[str, float | None],
    host: str,
    port: int,
    token: bool,
    browser: bool,
) -> bool:
    """Show a scene or a photo until somebody stops it; False where work is left over that cannot be interrupted.

    `uploads` completes photos, the first with the depth and calibration of its base and with `lens`, `focal_px` and
    `fov`. With `token` only who knows the page's address gets in. InputError for a file that is neither, or an option
    that cannot be used.
    """
    reporter, base = uploads.reporter, uploads.first
    begin: Callable[[ViewerServer], object]
    if is_scene(target):
        if base.depth is not None:
            raise InputError(f"--depth {base.depth}: {target.name} is a scene already: leave the option out")
        with reporter.stage("load"):
            scene = Scene.load(target, **lens)
            begin = functools.partial(ViewerServer.show, scene=with_downloads(page_of(scene, target), scene))
    else:
        pipeline = uploads.open(base)
        with reporter.stage("load"):
            photo = load_photo(target, keep_frame=uploads.keep_frame or pipeline.options.give_geometry, **lens)
            if base.depth is not None:
                pipeline.base.load(photo)  # what is wrong with a depth map is known before a page opens

        def complete_first(tell: Tell) -> PageScene:
            return complete_for_page(photo, target.name, pipeline, Teller(reporter, tell))

        begin = functools.partial(ViewerServer.work, job=complete_first)
    with asked_to_stop(alone=True) as stopped:
        secret = secrets.token_urlsafe(16) if token else ""
        talk = {"log": reporter.detail, "bases": uploads.bases, "token": secret}
        server = ViewerServer(page_files(), uploads.complete, host=host, port=port, **talk)  # type: ignore[arg-type]
        try:
            server.start()
            begin(server)
            announce(server, target.name, reporter, browser=browser)
            while not stopped():
                time.sleep(0.05)
        finally:
            ended = server.close()
    return ended


def is_scene(path: Path) -> bool:
    """Whether a file claims to be a scene, by its name or its first bytes; InputError for a missing or empty file."""
    check_file(path, "photo or scene")
    if path.suffix.lower() in WRITTEN_ONLY:
        raise InputError(f"{path}: {path.suffix} files are written, not read: give the scene.ply that it was made of")
    with open(path, "rb") as file:
        return path.suffix.lower() == ".ply" or file.read(3) == b"ply"


def complete_for_page(photo: Photo, name: str, pipeline: Pipeline, teller: Teller) -> PageScene:
    """A loaded photo to what the page shows; the terminal gets errors too."""
    try:
        done = pipeline.complete(photo, teller)
        note = ROUGH if done.choice.base == LiteBase.name else ""
        with teller.stage("page"):
            return with_downloads(done.scene.page(name, note), done.scene)
    except InputError as error:
        Reporter.log(teller, f"error: {error}")  # the page is told as the job ends
        raise


def with_downloads(page: PageScene, scene: Scene) -> PageScene:
    """The page's scene, and the files that it can be saved as."""

    def encoded(suffix: str) -> bytes:
        name = Path(f"scene{suffix}")
        return encoder_of(name)(SceneFile(name, scene.gaussians, scene.camera, len(scene.base), scene.disparity))

    return dataclasses.replace(page, downloads={suffix: functools.partial(encoded, suffix) for suffix in DOWNLOADS})


class Uploads:
    """Completes photos that the page sends; the first photo's depth, calibration and lens do not apply to them."""

    def __init__(self, base: BaseSettings, disparity: float | None, keep_frame: bool, reporter: Reporter) -> None:
        """InputError: an option that cannot be used."""
        self.first, self.keep_frame, self.reporter = base, keep_frame, reporter
        name = AUTO if base.name == "rgbd" else base.name
        self._base = dataclasses.replace(base, name=name, depth=None, calib=None, depth_kind="auto")
        self._base.check()
        self._path = PathOptions(disparity=disparity)
        self._path.check()
        self._opened: tuple[BaseSettings, Pipeline] | None = None  # the command's own base, which holds its network

    def open(self, settings: BaseSettings) -> Pipeline:
        """The way of photos through a base; InputError for an option that cannot be used."""
        if self._opened is not None and self._opened[0] == settings:
            return self._opened[1]
        pipeline = Pipeline.open(Options(settings, self._path))
        if settings == self._base:
            self._opened = settings, pipeline
        return pipeline

    @property
    def bases(self) -> list[str]:
        """What the page offers: the command's own, auto, and those that need no download."""
        return list(dict.fromkeys([self._base.name, AUTO, *BaseSettings().files]))

    def complete(
        self, path: Path, name: str, tell: Tell, *, base: str = "", disparity: str = "", depth: Path | None = None
    ) -> PageScene:
        """A photo's file to what the page shows, as it chose; the server calls it for one photo at a time.

        InputError for a choice that was not offered.
        """
        teller = Teller(self.reporter, tell, path, name)
        settings = self._base
        if depth is not None:
            kind = self.first.depth_kind
            settings = dataclasses.replace(settings, name=AUTO, depth=depth, depth_kind=kind, checkpoint=None)
        elif base not in ("", settings.name):
            check_name("base", base, self.bases)
            settings = dataclasses.replace(settings, name=base, checkpoint=None)
        pipeline = self.open(settings)
        if disparity:
            try:
                chosen = PathOptions(disparity=float(disparity))
            except ValueError as error:
                raise InputError(f"disparity {disparity}: give a number from 0 to 2") from error
            chosen.check()
            pipeline = dataclasses.replace(pipeline, options=dataclasses.replace(pipeline.options, path=chosen))
        with teller.stage("load"):
            photo = load_photo(path, keep_frame=self.keep_frame or pipeline.options.give_geometry)
        return complete_for_page(photo, name, pipeline, teller)


class Teller(Reporter):
    """A reporter that sends the page what the terminal gets."""

    def __init__(self, reporter: Reporter, tell: Tell, path: Path | None = None, name: str = "") -> None:
        """`path` is an uploaded file, which messages call `name`."""
        super().__init__(reporter.verbose, reporter.console)
        self._tell, self._path, self._name = tell, path, name

    def log(self, line: str) -> None:
        if self._path is not None:
            line = line.replace(str(self._path), self._name).replace(self._path.name, self._name)
        super().log(line)
        self._tell({"line": line})

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Step]:
        """As `Reporter.stage`; a total of 0 is unknown."""
        self._tell({"stage": name, "done": 0, "total": 0})
        with super().stage(name) as step:

            def advance(done: int, total: int) -> None:
                step(done, total)
                self._tell({"stage": name, "done": done, "total": total})

            yield advance


def announce(server: ViewerServer, name: str, reporter: Reporter, *, browser: bool) -> None:
    """Print the page's address, warn if it is open to the network, and open a browser if there is a screen."""
    if not server.local:
        reporter.log(
            f"warning: everybody in the network can see this photo at --host {server.host}, send photos of their own "
            "and use this machine to complete them; the connection is not encrypted"
        )
        reporter.log(f"{name}: from other machines {server.url_at(address_in_network(server.host))}")
    reporter.log(f"{name}: {server.url} (Ctrl-C ends)")
    reporter.result({"url": server.url})
    # A browser of text would take the terminal away.
    screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if browser and sys.platform.startswith("linux") and not screen:
        reporter.log("no screen here: open that page yourself; from another machine through `ssh -L`")
    elif browser:
        # Some browsers come back only when they are closed.
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True, name="browser").start()


def address_in_network(host: str) -> str:
    """The address by which others reach this machine, listening at `host`."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # an address of documentation: asking for the way there sends nothing
        return str(probe.getsockname()[0])
    return socket.gethostname()  # no network
