"""`spackle view` as people use it: a page that opens, photos that become scenes, and an end when they want it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from command import Run, refuses, report_of, run
from photos import write_pair, write_photo
from portraits import apple_jpeg, codes
from scenes import box_before_wall
from web_client import ask, events, send

import spackle
from spackle.bases.settings import ROUGH
from spackle.formats import save_ply
from spackle.image import film_to_pixels

# The command line in a process of its own; a photo takes for ever.
DEAF = """
import time
from spackle import cli
from spackle.pipeline import Pipeline

def for_ever(self, photo, reporter):
    with reporter.stage("base"):
        time.sleep(60)

Pipeline.complete = for_ever
cli.main()
"""


@pytest.fixture
def visit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Runs `spackle view` until a browser, which is a function here, has seen enough; then a signal ends it."""
    monkeypatch.setenv("BROWSER", "anything")
    monkeypatch.setattr(os, "_exit", lambda code: pytest.fail("the job did not end"))

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


def counts(description: Any) -> dict[str, int]:
    return {layer["name"]: layer["count"] for layer in description["layers"]}


def test_a_scene_keeps_its_parts_and_its_camera(tmp_path: Path, visit: Callable[..., Run]) -> None:
    scene, path, count = box_before_wall(), tmp_path / "scene.ply", len(box_before_wall().base())
    seen: list[Any] = []

    def browse(url: str) -> None:
        assert b"<html" in ask(url).body
        seen.append(ask(url, ask(url, "/scene.json").json["scene"]).json)

    save_ply(scene.base(), path, camera=scene.camera, base_count=count - 10)
    result = visit(browse, path)
    assert (result.code, result.lines[-1]) == (130, "interrupted")
    assert not any(line.startswith("warning") for line in result.lines)
    assert (seen[0]["name"], counts(seen[0])) == (tmp_path.name, {"base": count - 10, "aux": 10})
    assert seen[0]["camera"]["K"] == scene.camera.K.tolist()
    save_ply(scene.base(), path)  # a stranger's: all base, behind a usual lens
    result = visit(browse, path, "--host", "0.0.0.0", end=signal.SIGTERM)
    assert (result.code, result.lines[0].startswith("warning: ")) == (130, True)  # open to the network
    assert visit(browse, path, "--fov", "90").code == 130
    for description, focal in zip(seen[1:], (film_to_pixels(30, 1280, 720), 640), strict=True):
        assert counts(description) == {"base": count, "aux": 0}
        assert description["camera"]["K"][0] == pytest.approx([focal, 0, 640])


def test_a_photo_is_completed_as_predict_completes_it(
    tmp_path: Path, visit: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    photo, depth = write_pair(tmp_path / "first")
    given = ("--depth", depth, "--depth-kind", "metric", "--fov", "50")
    assert run("predict", "-i", photo, *given, "-o", tmp_path / "out", "--no-render").code == 0
    report = report_of(tmp_path / "out" / "photo")
    told: list[list[Any]] = []
    seen: list[dict[str, Any]] = []

    def browse(url: str) -> None:
        assert ask(url, "/scene.json").json["scene"] in (None, "/scenes/1.json")
        told.append(events(url, "/jobs/1"))
        seen.append(ask(url, told[0][-1]["ready"]).json)
        told.append(events(url, send(url, apple_jpeg(codes()), "my%20other.jpg").json["job"]))
        seen.append(ask(url, ask(url, "/scene.json").json["scene"]).json)
        seen.append(ask(url, events(url, send(url, name="rough.png").json["job"])[-1]["ready"]).json)

    result = visit(browse, photo, *given)
    assert result.code == 130, result.err
    assert {event["stage"] for event in told[0] if "stage" in event} <= {"prepare", "base", "move", "complete", "page"}
    assert counts(seen[0]) == {"base": report["base"]["gaussians"], "aux": report["aux"]["gaussians"]}
    assert any("focal length" in event.get("line", "") for event in told[0])
    assert "ready" in told[1][-1], told
    assert [description["name"] for description in seen] == ["photo.png", "my other.jpg", "rough.png"]
    assert [description["note"] for description in seen] == ["", "", ROUGH]  # by lite, which stays near
    assert seen[2]["orbit"]["free"] <= 0.15
    first, other = ([line for line in result.lines if line.startswith(f"{each['name']}: ")] for each in seen[:2])
    assert any("Gaussians from rgbd" in line for line in first)
    assert any("--fov" in line for line in first)
    assert other[0].startswith("my other.jpg: base rgbd (the depth in the photo)")
    assert not any("--fov" in line for line in other)  # what was said of the first photo
    assert not any("upload." in line for line in result.lines)
    assert not list(tmp_path.glob("spackle-view-*"))
    # A photo that cannot be completed leaves the page to others.
    result = visit(lambda url: told.append(events(url, "/jobs/1")), photo, "--base", "rgbd")
    assert told[-1][-1]["error"].startswith(f"{photo}: --base rgbd needs depth")
    assert (result.code, any(line.startswith("error: ") for line in result.lines)) == (130, True)


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No page may open."""
    monkeypatch.setattr("spackle.cli.view_page.announce", lambda *_, **__: pytest.fail("there is a page"))


@pytest.mark.usefixtures("closed")
@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("text.txt", b"hello", "not an image"),
        ("written.spz", b"anything", "scene.ply"),  # a format that is written, not read
        ("scene.jpg", b"ply\nformat ascii 1.0\nend_header\n", "not a Gaussian scene"),
        ("missing.jpg", None, "no such photo or scene"),
        ("behind.ply", None, "in front of the photo's camera"),
    ],
)
def test_files_that_are_neither_scene_nor_photo(tmp_path: Path, name: str, content: bytes | None, why: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    elif name == "behind.ply":
        save_ply(box_before_wall().base().transform(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))), tmp_path / name)
    refuses(run("view", tmp_path / name), name, why)


@pytest.mark.usefixtures("closed")
@pytest.mark.parametrize("target", ["photo.png", "scene.ply"])
def test_bad_options(tmp_path: Path, target: str) -> None:
    write_photo(tmp_path / "photo.png")
    save_ply(box_before_wall().base(), tmp_path / "scene.ply")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        bad = ["--base shrap", "--disparity 7", "--fov 200", "--depth none.npy", f"--port {taken.getsockname()[1]}"]
        for option in (*bad, "--port 70000", "--port -1", "--host no.such.host.invalid", "--host 192.0.2.1"):
            name, value = option.split()
            refuses(run("view", tmp_path / target, name, value), value if name == "--depth" else name)


def test_it_ends_at_once_whatever_it_is_at(tmp_path: Path) -> None:
    photo, folder = write_photo(tmp_path / "photo.png"), tmp_path / "temporary"
    folder.mkdir()
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": str(Path(spackle.__file__).parents[1])}
    command = [sys.executable, "-c", DEAF, "view", str(photo), "--base", "lite", "--no-open"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            assert "http://127.0.0.1:" in line, line
            url = line[line.index("http") :].split()[0]
            with urllib.request.urlopen(f"{url}jobs/1/events", timeout=10) as listener:
                assert any(b'"base"' in line for line in listener)  # that stage has begun
                assert os.listdir(folder)
                start = time.monotonic()
                process.send_signal(signal.SIGINT)
                assert b"stopped" in listener.read()
            assert process.wait(10) == 130
            assert time.monotonic() - start < 5  # a second, where nobody else wants the processor
            assert process.stderr.read().splitlines()[-1] == "interrupted"
            assert not os.listdir(folder)
        finally:
            process.kill()
