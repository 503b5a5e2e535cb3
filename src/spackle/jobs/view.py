"""`spackle view`: a scene, or a photo that becomes one, on a page of this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from spackle.bases.open import AUTO
from spackle.errors import InputError
from spackle.formats.scene_files import SceneFile
from spackle.image import Photo, load_photo
from spackle.jobs.options import PredictOptions, check_options
from spackle.jobs.predict import complete_photo
from spackle.jobs.setup import Tools, set_up
from spackle.jobs.view_open import announce
from spackle.jobs.view_scene import is_scene, page_of
from spackle.progress import Reporter, Step
from spackle.signals import asked_to_stop
from spackle.viewer import PageScene, page_files, page_scene
from spackle.viewer.server import HOST, ViewerServer
from spackle.viewer.work import Tell

Begin = Callable[[ViewerServer], object]
LOOK = 0.05  # seconds between two looks whether somebody wants to stop


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """The choices of `spackle view`."""

    predict: PredictOptions  # how photos are completed
    host: str = HOST
    port: int = 0  # any that is free
    browser: bool = True  # open one


def view(target: Path, options: ViewOptions, reporter: Reporter) -> bool:
    """Show a scene or a photo until somebody stops it; False where work is left over that cannot be interrupted.

    Raises:
        InputError: a file that is neither, or an option that cannot be used.
    """
    uploads = Uploads(options.predict, reporter)
    begin = _first(target, options.predict, uploads, reporter)
    with asked_to_stop(alone=True) as stopped:
        server = ViewerServer(page_files(), uploads.complete, host=options.host, port=options.port, log=reporter.detail)
        try:
            server.start()
            begin(server)
            announce(server, target.name, reporter, browser=options.browser)
            while not stopped():
                time.sleep(LOOK)
        finally:
            ended = server.close()
    return ended


def _first(target: Path, options: PredictOptions, uploads: Uploads, reporter: Reporter) -> Begin:
    """What the server begins with: a scene that it shows, or a photo that it works on."""
    seconds: dict[str, float] = {}
    if is_scene(target):
        if options.depth is not None:
            raise InputError(f"--depth {options.depth}: {target.name} is a scene already: leave the option out")
        with reporter.stage("load", seconds):
            scene = page_of(SceneFile.load(target), options)
        return lambda server: server.show(scene)
    tools = set_up(options)
    if options.depth is None:
        uploads.tools = tools  # they hold its network
    with reporter.stage("load", seconds):
        photo = load_photo(target, focal_px=options.focal_px, focal_mm=options.focal_mm, fov=options.fov)
        if options.depth is not None:
            tools.opened.load(photo)  # what is wrong with a depth map is known before a page opens

    def complete_first(tell: Tell) -> PageScene:
        return complete(photo, target.name, options, tools, Teller(reporter, tell))

    return lambda server: server.work(complete_first)


def complete(photo: Photo, name: str, options: PredictOptions, tools: Tools, teller: Teller) -> PageScene:
    """A loaded photo to what the page shows; what goes wrong is said here too."""
    seconds: dict[str, float] = {}
    try:
        done = complete_photo(photo, name, options, tools, teller, seconds)
        with teller.stage("page", seconds):
            completed, camera = done.completed, done.prediction.camera
            return page_scene(name, completed.base, completed.aux, camera, options.disparity)
    except InputError as error:
        Reporter.say(teller, f"error: {error}")  # the page is told as the job ends
        raise


class Uploads:
    """Completes photos that the page sends; what was said of the first photo alone does not hold for them."""

    def __init__(self, options: PredictOptions, reporter: Reporter) -> None:
        """InputError: an option that cannot be used."""
        base = AUTO if options.base == "rgbd" else options.base
        self._options = dataclasses.replace(
            options, base=base, depth=None, calib=None, focal_px=None, focal_mm=None, fov=None
        )
        check_options(self._options)
        self._reporter = reporter
        self.tools: Tools | None = None

    def complete(self, path: Path, name: str, tell: Tell) -> PageScene:
        """As the server wants it: one at a time."""
        teller = Teller(self._reporter, tell, path, name)
        self.tools = self.tools or set_up(self._options)
        seconds: dict[str, float] = {}
        with teller.stage("load", seconds):
            photo = load_photo(path)
        return complete(photo, name, self._options, self.tools, teller)


class Teller(Reporter):
    """Tells the page what the terminal is told."""

    def __init__(self, reporter: Reporter, tell: Tell, path: Path | None = None, name: str = "") -> None:
        """`path` is a file of ours that people know by `name`."""
        super().__init__(reporter.verbose, reporter.console)
        self._tell, self._path, self._name = tell, path, name

    def say(self, line: str) -> None:
        if self._path is not None:
            line = line.replace(str(self._path), self._name).replace(self._path.name, self._name)
        super().say(line)
        self._tell({"line": line})

    def detail(self, line: str) -> None:
        """For the terminal alone."""
        if self.verbose:
            super().say(line)

    @contextlib.contextmanager
    def stage(self, name: str, seconds: dict[str, float]) -> Iterator[Step]:
        """As ever; a total of 0 means that it is not known."""
        self._tell({"stage": name, "done": 0, "total": 0})
        with super().stage(name, seconds) as step:

            def advance(done: int, total: int) -> None:
                step(done, total)
                self._tell({"stage": name, "done": done, "total": total})

            yield advance
