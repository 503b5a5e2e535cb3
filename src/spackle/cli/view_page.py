"""`spackle view`: a scene, or a photo that becomes one, on a page of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import secrets
import socket
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path

from spackle.bases.lite import LiteBase
from spackle.bases.settings import AUTO, ROUGH, BaseSettings
from spackle.cli.export_scene import page_of
from spackle.errors import InputError, check_name
from spackle.files import check_file
from spackle.image import Photo, load_photo
from spackle.pipeline import Options, Pipeline
from spackle.progress import Reporter, Step, asked_to_stop
from spackle.scene import Scene
from spackle.viewer import PageScene, page_files
from spackle.viewer.server import HOST, ViewerServer
from spackle.viewer.work import Tell
from spackle.views import PathOptions
from spackle.weights import installed

DOWNLOADS = (".ply", ".spz", ".sog")  # of a scene that the page shows
WRITTEN_ONLY = (".spz", ".splat", ".sog", ".glb", ".html")
OPEN_TO_ALL = (
    "warning: everybody in the network can see this photo at --host {host}, send photos of their own and use this "
    "machine to complete them; the connection is not encrypted"
)
ELSEWHERE = ("192.0.2.1", 9)  # an address of documentation: asking for the way there sends nothing


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """The choices of `spackle view`."""

    base: BaseSettings
    disparity: float | None = None  # how far photos are completed; as the base has it where None
    focal_px: float | None = None  # of the scene or the photo
    fov: float | None = None
    host: str = HOST
    port: int = 0  # any that is free
    browser: bool = True  # open one
    keep_frame: bool = False  # a uniform frame around a photo is part of it
    token: bool = True  # only who knows the address gets in

    def open(self, base: BaseSettings) -> Pipeline:
        """The way of photos through a base; InputError for an option that cannot be used."""
        return Pipeline.open(Options(base, PathOptions(disparity=self.disparity)))


def is_scene(path: Path) -> bool:
    """Whether a file claims to be a scene, by its name or its first bytes; InputError for a missing or empty file."""
    check_file(path, "photo or scene")
    if path.suffix.lower() in WRITTEN_ONLY:
        raise InputError(f"{path}: {path.suffix} files are written, not read: give the scene.ply that it was made of")
    with open(path, "rb") as file:
        return path.suffix.lower() == ".ply" or file.read(3) == b"ply"


def view(target: Path, options: ViewOptions, reporter: Reporter) -> bool:
    """Show a scene or a photo until somebody stops it; False where work is left over that cannot be interrupted.

    InputError for a file that is neither, or an option that cannot be used.
    """
    uploads = Uploads(options, reporter)
    begin = _first(target, options, uploads, reporter)
    with asked_to_stop(alone=True) as stopped:
        where = {"host": options.host, "port": options.port}
        token = secrets.token_urlsafe(16) if options.token else ""
        talk = {"log": reporter.detail, "bases": uploads.bases, "token": token}
        server = ViewerServer(page_files(), uploads.complete, **where, **talk)  # type: ignore[arg-type]
        try:
            server.start()
            begin(server)
            announce(server, target.name, reporter, browser=options.browser)
            while not stopped():
                time.sleep(0.05)
        finally:
            ended = server.close()
    return ended


def _first(
    target: Path, options: ViewOptions, uploads: Uploads, reporter: Reporter
) -> Callable[[ViewerServer], object]:
    """What the server begins with: a scene that it shows, or a photo that it works on."""
    depth = options.base.depth
    if is_scene(target):
        if depth is not None:
            raise InputError(f"--depth {depth}: {target.name} is a scene already: leave the option out")
        with reporter.stage("load"):
            scene = Scene.load(target, focal_px=options.focal_px, fov=options.fov)
            page = with_downloads(page_of(scene, target), scene)
        return lambda server: server.show(page)
    pipeline = options.open(options.base)
    if depth is None:
        uploads.pipeline = pipeline  # it holds the network
    with reporter.stage("load"):
        photo = load_photo(target, focal_px=options.focal_px, fov=options.fov, keep_frame=options.keep_frame)
        if depth is not None:
            pipeline.base.load(photo)  # what is wrong with a depth map is known before a page opens

    def complete_first(tell: Tell) -> PageScene:
        return complete_for_page(photo, target.name, pipeline, Teller(reporter, tell))

    return lambda server: server.work(complete_first)


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

    def made(suffix: str) -> bytes:
        with tempfile.TemporaryDirectory(prefix="spackle-view-") as folder:
            file = Path(folder) / f"scene{suffix}"
            scene.export(file)
            return file.read_bytes()

    return dataclasses.replace(page, downloads={suffix: functools.partial(made, suffix) for suffix in DOWNLOADS})


class Uploads:
    """Completes photos that the page sends; the first photo's depth, calibration and lens do not apply to them."""

    def __init__(self, options: ViewOptions, reporter: Reporter) -> None:
        """InputError: an option that cannot be used."""
        base = options.base
        name = AUTO if base.name == "rgbd" else base.name
        self._options, self._reporter = options, reporter
        self._base = dataclasses.replace(base, name=name, depth=None, calib=None)
        self._base.check()
        PathOptions(disparity=options.disparity).check()
        self.pipeline: Pipeline | None = None

    @property
    def bases(self) -> list[str]:
        """What the page offers: the command's own, auto, and those that need no download."""
        here = [name for name in ("sharp", "depth") if installed(name)]
        return list(dict.fromkeys([self._base.name, AUTO, *here, LiteBase.name]))

    def complete(
        self, path: Path, name: str, tell: Tell, *, base: str = "", disparity: str = "", depth: Path | None = None
    ) -> PageScene:
        """A photo's file to what the page shows, as it chose; the server calls it for one photo at a time.

        InputError for a choice that was not offered.
        """
        teller = Teller(self._reporter, tell, path, name)
        settings = self._chosen(base, depth)
        if settings is not self._base:
            pipeline = self._options.open(settings)
        else:
            pipeline = self.pipeline = self.pipeline or self._options.open(settings)
        if disparity:
            chosen = PathOptions(disparity=_number(disparity))
            chosen.check()
            pipeline = dataclasses.replace(pipeline, options=dataclasses.replace(pipeline.options, path=chosen))
        with teller.stage("load"):
            photo = load_photo(path, keep_frame=self._options.keep_frame)
        return complete_for_page(photo, name, pipeline, teller)

    def _chosen(self, base: str, depth: Path | None) -> BaseSettings:
        if depth is not None:
            return dataclasses.replace(self._base, name=AUTO, depth=depth, checkpoint=None)
        if base in ("", self._base.name):
            return self._base
        check_name("base", base, self.bases)
        return dataclasses.replace(self._base, name=base, checkpoint=None)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"disparity {text}: give a number from 0 to 2") from error


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

    def detail(self, line: str) -> None:
        """For the terminal alone."""
        if self.verbose:
            super().log(line)

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
        reporter.log(OPEN_TO_ALL.format(host=server.host))
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
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(ELSEWHERE)
            return str(probe.getsockname()[0])
    except OSError:  # no network
        return socket.gethostname()
