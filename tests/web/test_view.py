"""`spackle view` and `spackle serve`: the page opens, photos become scenes, and signals end the
server.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from helpers.command import Run, refuses, report_of, run
from helpers.foreign_scenes import khr_gltf, sog
from helpers.photos import write_pair, write_photo
from helpers.portraits import PORTRAIT
from helpers.scenes import box_before_wall, random_gaussians, random_harmonics
from helpers.systems import needs_posix_signals
from helpers.web_client import PATIENCE_S, SCENES, Served, eventually

import spackle
from spackle.formats import save_ply
from spackle.web.work import ROUGH_DEPTH_NOTE


def served_at(url: str) -> tuple[Served, str]:
    """The server, and the scene that the page's address names."""
    parts = urlsplit(url)
    return Served(parts.port or 0, parts.path.rstrip("/")), parts.fragment


def page_of(server: Served, id: str) -> Any:
    """The description of a finished scene, as the page loads it."""
    assert server.events(id)[-1]["error"] is None
    return server.ask(f"{SCENES}/{id}/files/page.json").json


@pytest.fixture
def visit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Run `spackle view` with a function as the browser; a signal ends the command when the
    function returns.
    """
    monkeypatch.setenv("BROWSER", "anything")

    def run_view(
        browse: Callable[[Served, str], object], *arguments: object, end: int = signal.SIGINT
    ) -> Run:
        failed: list[BaseException] = []

        def browser(url: str) -> bool:
            try:
                browse(*served_at(url))
            except BaseException as error:
                failed.append(error)
            signal.raise_signal(end)
            return True

        monkeypatch.setattr("webbrowser.open", browser)
        result = run("view", *arguments)
        if failed:
            raise failed[0]
        return result

    return run_view


def counts(page: Any) -> dict[str, int]:
    return {layer["name"]: layer["count"] for layer in page["layers"]}


def test_a_scene_keeps_its_parts_and_its_camera(tmp_path: Path, visit: Callable[..., Run]) -> None:
    scene, path, count = box_before_wall(), tmp_path / "scene.ply", len(box_before_wall().base())
    seen: list[Any] = []

    def browse(server: Served, id: str) -> None:
        seen.append(page_of(server, id))
        assert server.ask(f"{SCENES}/{id}").json["files"] == [
            "scene.ply"
        ]  # there is no photo to show meanwhile
        assert server.ask(f"{SCENES}/{id}/files/scene.spz").body[:2] == b"\x1f\x8b"
        assert server.ask(f"{SCENES}/{id}/files/report.json").status == 404

    save_ply(scene.base(), path, camera=scene.camera, base_count=count - 10)
    result = visit(browse, path)
    assert (result.code, result.lines[-1]) == (130, "interrupted")
    assert (seen[0]["name"], counts(seen[0])) == (tmp_path.name, {"base": count - 10, "aux": 10})
    assert seen[0]["camera"]["K"] == scene.camera.K.tolist()
    save_ply(scene.base(), path)  # a stranger's: all base
    result = visit(browse, path, "--fov", "90", "--host", "0.0.0.0", end=signal.SIGTERM)
    assert (result.code, result.lines[0].startswith("warning: ")) == (
        130,
        True,
    )  # open to the network
    assert counts(seen[1]) == {"base": count, "aux": 0}
    assert seen[1]["camera"]["K"][0] == pytest.approx([640, 0, 640])


@pytest.mark.parametrize("given", ["folder", "meta.json", "scene.glb"])
def test_a_scene_of_another_program_is_shown_with_its_harmonics(
    given: str, tmp_path: Path, visit: Callable[..., Run]
) -> None:
    folder = tmp_path / "garden"
    folder.mkdir()
    gaussians = random_gaussians(30)
    shiny = dataclasses.replace(gaussians, harmonics=random_harmonics(30, 3))
    for name, content in sog(shiny, 2).items():
        (folder / name).write_bytes(content)
    (folder / "scene.glb").write_bytes(khr_gltf(gaussians).glb())
    seen: list[Any] = []
    target = folder if given == "folder" else folder / given
    result = visit(lambda server, id: seen.append(page_of(server, id)), target)
    assert counts(seen[0]) == {"base": 30, "aux": 0}
    assert seen[0]["note"] == ""
    assert "harmonics" not in result.out + result.err
    shown = seen[0]["layers"][0].get("harmonics", {"count": 0})
    assert shown["count"] == (0 if given == "scene.glb" else 15)
    assert seen[0]["name"] == ("scene" if given == "scene.glb" else "garden")


def test_a_photo_is_completed_as_predict_completes_it(
    tmp_path: Path, visit: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    photo, depth = write_pair(tmp_path / "first")
    given = ("--depth", depth, "--depth-kind", "metric", "--fov", "50")
    assert run("predict", photo, *given, "-o", tmp_path / "out", "--no-render").code == 0
    report = report_of(tmp_path / "out" / "photo")
    seen: list[dict[str, Any]] = []

    def browse(server: Served, id: str) -> None:
        seen.append(page_of(server, id))
        film = server.ask(f"{SCENES}/{id}/files/shake.mp4")
        assert (film.status, film.body[4:8]) == (200, b"ftyp")
        seen.append(page_of(server, server.send(PORTRAIT, "my other.jpg").json["id"]))
        seen.append(page_of(server, server.send(name="rough.png").json["id"]))

    result = visit(browse, photo, *given)
    assert result.code == 130, result.err
    assert photo.is_file()
    assert counts(seen[0]) == {
        "base": report["base"]["gaussians"],
        "aux": report["aux"]["gaussians"],
    }
    assert [page["name"] for page in seen] == ["photo.png", "my other.jpg", "rough.png"]
    assert [page["note"] for page in seen] == [
        "",
        "",
        ROUGH_DEPTH_NOTE,
    ]  # by lite, which stays near
    assert seen[2]["orbit"]["free"] <= 0.15
    first, other = (
        [line for line in result.lines if line.startswith(f"{page['name']}: ")] for page in seen[:2]
    )
    assert any("Gaussians from rgbd" in line for line in first)
    assert any("(fov)" in line for line in first)
    assert other[0].startswith("my other.jpg: base rgbd (the depth in the photo)")
    assert not any(
        "(fov)" in line or "source." in line for line in other
    )  # what was said of the first photo
    assert not list(tmp_path.glob("spackle-view-*"))


def test_an_empty_page_offers_photos(visit: Callable[..., Run]) -> None:
    def browse(server: Served, id: str) -> None:
        assert (id, b"<html" in server.ask().body) == ("", True)
        assert "lite" in server.ask("/page.json").json["upload"]["bases"]
        assert all(server.ask(f"/{name}.jpg").body[:2] == b"\xff\xd8" for name in ("coffee", "cat"))

    assert visit(browse).code == 130


def test_bad_files_and_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "spackle.web.local_server.announce", lambda *_: pytest.fail("there is a page")
    )
    (tmp_path / "foreign.ksplat").write_bytes(b"anything")  # a format that cannot be read
    (tmp_path / "scene.jpg").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    behind = dataclasses.replace(base := box_before_wall().base(), means=-base.means)
    save_ply(behind, tmp_path / "behind.ply")
    known = {"foreign.ksplat": "convert", "scene.jpg": "Gaussian scene", "no.jpg": "no such photo"}
    known |= {"behind.ply": "front"}
    for name, why in known.items():
        refuses(run("view", tmp_path / name), name, why)
    photo = write_photo(tmp_path / "photo.png")
    refuses(run("view", photo, "--host", "0.0.0.0", "--no-token"), "--no-token")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bad = [
            "--base shrap",
            "--disparity 7",
            "--fov 200",
            "--depth none.npy",
            f"--port {taken.getsockname()[1]}",
        ]
        for option in (*bad, "-c no.safetensors", "--port 70000", "--host no.such.host.invalid"):
            name, value = option.split()
            refuses(
                done := run("view", photo, name, value),
                value if name in ("--depth", "-c") else name,
            )
            assert done.err.count("127.0.0.1") < 2


@needs_posix_signals
def test_a_service_ends_at_once_whatever_it_is_at(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "photo.png", 1500, 1000)  # seconds of work
    environment = {**os.environ, "PYTHONPATH": str(Path(spackle.__file__).parents[1])}
    command = [
        sys.executable,
        "-m",
        "spackle",
        "serve",
        "--port",
        "0",
        "-o",
        tmp_path / "scenes",
        "--base",
        "lite",
    ]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    ) as process:
        try:
            assert process.stderr is not None
            lines = [process.stderr.readline(), process.stderr.readline()]
            token = lines[0].split()[1].rstrip(",")
            server, _ = served_at(lines[1][lines[1].index("http:") :].split()[0])
            assert server.root == f"/{token}"
            id = server.send(photo.read_bytes()).json["id"]
            eventually(lambda: server.ask(f"{SCENES}/{id}").json["state"] == "running")
            os.killpg(process.pid, signal.SIGTERM)  # as a service manager ends it
            assert process.wait(PATIENCE_S) == 130
            assert process.stderr.read().splitlines()[-1] == "interrupted"
            # It did not wait for the photo, whose work goes on when the service starts again.
            record = (tmp_path / "scenes" / id / "job.json").read_text()
            assert '"state": "running"' in record
        finally:
            process.kill()
