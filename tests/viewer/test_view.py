"""`spackle view` as people use it: a page that opens, photos that become scenes, and an end when they want it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
import torch
from command import Run, report_of, run
from photos import write_pair, write_photo
from portraits import apple_jpeg, codes
from scenes import box_before_wall

import spackle
from spackle.app.export import page_of
from spackle.formats import save_ply
from spackle.formats.scene_files import SceneFile
from spackle.image import film_to_pixels

# The command line in a process of its own; a photo takes for ever.
DEAF = """
import time
from spackle import cli
import spackle.app.view as view

def for_ever(photo, name, options, tools, reporter, seconds):
    with reporter.stage("base", seconds):
        time.sleep(60)

view.complete_photo = for_ever
cli.main()
"""


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test may end the process."""

    def refuse(code: int) -> NoReturn:
        raise AssertionError("the job did not end")

    monkeypatch.setattr(os, "_exit", refuse)


@pytest.fixture
def visit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Runs `spackle view` until a browser, which is a function here, has seen enough; then a signal ends it."""
    monkeypatch.setenv("BROWSER", "anything")

    def run_view(browse: Callable[[str], object], *arguments: object, end: int = signal.SIGINT) -> Run:
        failed: list[BaseException] = []

        def browser(url: str) -> bool:
            try:
                browse(url)
            except BaseException as error:
                failed.append(error)
            os.kill(os.getpid(), end)
            return True

        monkeypatch.setattr("webbrowser.open", browser)
        result = run("view", *arguments)
        if failed:
            raise failed[0]
        return result

    return run_view


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Runs `spackle view`, which has to end with one line before there is a page; the line."""

    def run_view(*arguments: object) -> str:
        monkeypatch.setattr("spackle.app.view.announce", lambda *_, **__: pytest.fail("there is a page"))
        result = run("view", *arguments)
        assert (result.code, len(result.lines)) == (2, 1), result.err
        return result.err

    return run_view


def get(url: str, path: str) -> Any:
    with urllib.request.urlopen(url.rstrip("/") + path, timeout=20) as answer:
        return json.load(answer)


def post(url: str, path: str, content: bytes) -> Any:
    with urllib.request.urlopen(url.rstrip("/") + path, content, timeout=20) as answer:
        return json.load(answer)


def hear(url: str, job: str) -> list[Any]:
    """Everything that a job tells, until it ends."""
    with urllib.request.urlopen(f"{url.rstrip('/')}{job}/events", timeout=60) as answer:
        return [json.loads(line[6:]) for line in answer if line.startswith(b"data: ")]


def counts(description: Any) -> dict[str, int]:
    return {layer["name"]: layer["count"] for layer in description["layers"]}


# Scenes


def test_a_scene_of_ours_keeps_its_two_parts_and_its_camera(tmp_path: Path, visit: Callable[..., Run]) -> None:
    scene = box_before_wall()
    save_ply(scene.base(), tmp_path / "scene.ply", camera=scene.camera, base_count=len(scene.base()) - 10)
    seen: dict[str, Any] = {}

    def browse(url: str) -> None:
        with urllib.request.urlopen(url, timeout=20) as page:
            seen["page"] = page.read()
        seen.update(get(url, get(url, "/scene.json")["scene"]))

    result = visit(browse, tmp_path / "scene.ply")
    assert (result.code, result.lines[-1]) == (130, "interrupted")
    assert b"<html" in seen["page"]
    assert seen["name"] == tmp_path.name  # every scene of ours is called scene.ply
    assert counts(seen) == {"base": len(scene.base()) - 10, "aux": 10}
    assert seen["camera"]["K"] == scene.camera.K.tolist()
    assert not any(line.startswith("warning") for line in result.lines)


def test_the_page_goes_as_far_as_the_scene_was_completed(tmp_path: Path) -> None:
    scene = box_before_wall()
    for stored, count, free in ((0.2, 10, 0.2), (None, 10, 0.3), (None, 0, 0.6), (5.0, 10, 1.0)):
        base = len(scene.base()) - count
        save_ply(scene.base(), tmp_path / "a.ply", camera=scene.camera, base_count=base, disparity=stored)
        orbit: Any = page_of(SceneFile.load(tmp_path / "a.ply")).description["orbit"]
        assert (orbit["free"], orbit["limit"]) == (free, pytest.approx(1.3 * free))


def test_a_strangers_scene_is_all_base_behind_a_usual_lens(tmp_path: Path, visit: Callable[..., Run]) -> None:
    scene = box_before_wall()
    save_ply(scene.base(), tmp_path / "theirs.ply")
    seen: list[Any] = []

    def browse(url: str) -> None:
        seen.append(get(url, "/scenes/1.json"))

    assert visit(browse, tmp_path / "theirs.ply", end=signal.SIGTERM).code == 130
    assert visit(browse, tmp_path / "theirs.ply", "--fov", "90").code == 130
    for description, focal in zip(seen, (film_to_pixels(30, 1280, 720), 640), strict=True):
        assert counts(description) == {"base": len(scene.base()), "aux": 0}
        assert description["camera"]["K"][0] == pytest.approx([focal, 0, 640])


# Photos


def test_a_photo_is_completed_as_predict_completes_it_and_another_without_what_was_said_of_the_first(
    tmp_path: Path, visit: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    photo, depth = write_pair(tmp_path / "first")
    given = ("--depth", depth, "--fov", "50")
    assert run("predict", "-i", photo, *given, "-o", tmp_path / "out", "--no-render").code == 0
    report = report_of(tmp_path / "out" / "photo")
    told: list[list[Any]] = []
    seen: list[dict[str, Any]] = []

    def browse(url: str) -> None:
        assert get(url, "/scene.json")["scene"] in (None, "/scenes/1.json")
        told.append(hear(url, "/jobs/1"))
        seen.append(get(url, told[0][-1]["ready"]))
        told.append(hear(url, post(url, "/photos?name=my%20other.jpg", apple_jpeg(codes()))["job"]))
        seen.append(get(url, get(url, "/scene.json")["scene"]))

    result = visit(browse, photo, *given)
    assert result.code == 130, result.err
    assert {event["stage"] for event in told[0] if "stage" in event} <= {"prepare", "base", "complete", "page"}
    assert counts(seen[0]) == {"base": report["base"]["gaussians"], "aux": report["aux"]["gaussians"]}
    assert any("focal length" in event.get("line", "") for event in told[0])
    assert "ready" in told[1][-1], told
    assert [description["name"] for description in seen] == ["photo.png", "my other.jpg"]
    first, other = ([line for line in result.lines if line.startswith(f"{each['name']}: ")] for each in seen)
    assert any("Gaussians from rgbd" in line for line in first)
    assert any("--fov" in line for line in first)
    assert other[0].startswith("my other.jpg: base rgbd (the depth in the photo)")
    assert not any("--fov" in line for line in other)
    assert not any("upload." in line for line in result.lines)
    assert not list(tmp_path.glob("spackle-view-*"))


def test_a_photo_that_cannot_be_completed_leaves_the_page_to_others(tmp_path: Path, visit: Callable[..., Run]) -> None:
    photo, _ = write_pair(tmp_path)
    told: list[Any] = []
    result = visit(lambda url: told.extend(hear(url, "/jobs/1")), photo, "--base", "rgbd")
    assert told[-1]["error"].startswith(f"{photo}: --base rgbd needs depth")
    assert any(line.startswith("error: ") for line in result.lines)
    assert result.code == 130


# How it begins


def test_a_port_may_be_taken_and_the_network_is_warned_of(tmp_path: Path, visit: Callable[..., Run]) -> None:
    save_ply(box_before_wall().base(), tmp_path / "scene.ply")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = run("view", tmp_path / "scene.ply", "--port", port, "--no-open")
        assert (result.code, len(result.lines)) == (2, 1)
        assert f"--port {port}: " in result.err
    urls: list[str] = []
    result = visit(urls.append, tmp_path / "scene.ply", "--port", port, "--host", "0.0.0.0")
    assert urls == [f"http://127.0.0.1:{port}/"]
    assert result.lines[0].startswith("warning: ")  # open to the network
    assert "--host 0.0.0.0" in result.lines[0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a screen")
def test_without_a_screen_no_browser_takes_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("webbrowser.open", lambda url: pytest.fail("a browser was opened"))
    monkeypatch.setattr("spackle.app.view.time.sleep", lambda seconds: os.kill(os.getpid(), signal.SIGINT))
    save_ply(box_before_wall().base(), tmp_path / "scene.ply")
    for options, hint in (((), True), (("--no-open",), False)):
        result = run("view", tmp_path / "scene.ply", *options)
        assert result.code == 130
        assert ("open that page yourself" in result.err) == hint


BAD = {
    "text.txt": (b"hello", "not an image"),
    "empty.jpg": (b"", "the file is empty"),
    "empty.ply": (b"", "the file is empty"),
    "cut.ply": (b"ply\nformat binary_little_endian 1.0\n", ""),
    "none.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "not a Gaussian scene"),
    "wrong.ply": (b"hello", ""),
    "written.spz": (b"anything", "scene.ply"),  # a format that is written, not read
    "scene.jpg": (b"ply\nformat ascii 1.0\nend_header\n", "not a Gaussian scene"),
}


@pytest.mark.parametrize("name", BAD)
def test_files_that_are_neither_scene_nor_photo(tmp_path: Path, name: str, refused: Callable[..., str]) -> None:
    (tmp_path / name).write_bytes(BAD[name][0])
    line = refused(tmp_path / name)
    assert name in line
    assert BAD[name][1] in line


def test_files_that_are_not_there_and_a_scene_behind_the_camera(tmp_path: Path, refused: Callable[..., str]) -> None:
    for target in (tmp_path / "none.ply", tmp_path / "none.jpg", tmp_path):
        assert str(target) in refused(target)
    behind = box_before_wall().base().transform(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])))
    save_ply(behind, tmp_path / "scene.ply")
    assert "in front of the photo's camera" in refused(tmp_path / "scene.ply")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--base", "shrap"), "--base shrap"),
        (("--disparity", "7"), "--disparity"),
        (("--fov", "200"), "--fov"),
        (("--depth", "none.npy"), "none.npy"),
        (("--port", "70000"), "--port 70000"),
        (("--host", "no.such.host.invalid"), "--host no.such.host.invalid"),
    ],
)
@pytest.mark.parametrize("kind", ["scene", "photo"])
def test_bad_options(
    tmp_path: Path, options: tuple[str, str], why: str, kind: str, refused: Callable[..., str]
) -> None:
    target = write_photo(tmp_path / "photo.png")
    if kind == "scene":
        target = tmp_path / "scene.ply"
        save_ply(box_before_wall().base(), target)
    assert why in refused(target, *options)


# How it ends


@contextlib.contextmanager
def deaf(photo: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that is at work on a photo and cannot be interrupted there, and the address of its page."""
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": str(Path(spackle.__file__).parents[1])}
    command = [sys.executable, "-c", DEAF, "view", str(photo), "--base", "lite", "--no-open"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert "http://127.0.0.1:" in line, line + process.stderr.read()
        yield process, line[line.index("http") :].split()[0]
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def test_it_ends_at_once_whatever_it_is_at(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    (tmp_path / "temporary").mkdir()
    with deaf(photo, tmp_path / "temporary") as (process, url):
        with urllib.request.urlopen(f"{url}jobs/1/events", timeout=10) as listener:
            assert any(b'"base"' in line for line in listener)  # that stage has begun
            assert os.listdir(tmp_path / "temporary")
            start = time.monotonic()
            process.send_signal(signal.SIGINT)
            assert b"stopped" in listener.read()
        assert process.wait(10) == 130
        assert time.monotonic() - start < 5  # a second, where nobody else wants the processor
        assert process.stderr is not None
        assert process.stderr.read().splitlines()[-1] == "interrupted"
        assert not os.listdir(tmp_path / "temporary")
