"""Each piece of work has an owner, a limit and an end, whatever clients send and disks do."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from helpers.photo_files import jpeg_of_scans
from helpers.systems import needs_proc
from helpers.web_client import (
    BOUNDARY,
    MAX_BYTES,
    SCENES,
    Served,
    answer_of,
    eventually,
    form,
    post,
    request,
    served,
)
from helpers.web_work import HUNGER_BYTES
from PIL import Image

from spackle.runtime.errors import InputError
from spackle.runtime.task_process import TaskLimits
from spackle.web.failures import without_folders
from spackle.web.jobs import Job, RetentionLimits

NO_SPACE = OSError(errno.ENOSPC, "No space left on device")
WANTED_HEADERS = {"x-content-type-options", "content-security-policy", "cache-control"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes"), max_bytes=4 * MAX_BYTES) as server:
        yield server


def test_a_photo_that_takes_too_long_to_decode_holds_up_nobody(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.jobs.DECODING_LIMITS", TaskLimits(cpu_seconds=0))
    # Just so many that the reader does not refuse them at once; they take two seconds.
    bomb = jpeg_of_scans(450)
    with ThreadPoolExecutor(1) as pool:
        reply = pool.submit(server.send, bomb, "bomb.jpg")
        assert server.send().status == 202
        refusal = reply.result()
    assert refusal.status == 415
    assert refusal.json["error"] == (
        "bomb.jpg: cannot be decoded: took longer than 0 seconds, the limit"
    )


@needs_proc
def test_a_photo_may_take_so_much_memory_to_decode(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.jobs.DECODING_LIMITS", TaskLimits(memory_bytes=50_000_000))
    Image.new("RGB", (6000, 5000), (9, 90, 9)).save(file := io.BytesIO(), "PNG")
    reply = server.send(file.getvalue())
    assert reply.status == 415
    assert "photo.png: cannot be decoded: needs more memory" in reply.json["error"]
    assert server.send().status == 202


def making(server: Served, id: str) -> list[Any]:
    return [dict(each) for each in server.ask(f"{SCENES}/{id}").json["making"]]


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def finished(server: Served, name: str) -> str:
    """The id of a finished scene of a photo with this name."""
    id: str = server.send(name=name).json["id"]
    assert server.events(id)[-1]["state"] == "done"
    return id


def test_a_long_video_holds_up_no_small_file_and_ends_with_its_scene(server: Served) -> None:
    id = finished(server, "endless.png")
    path = f"/s3cret{SCENES}/{id}/files/"
    with (
        server.dial(request(path + "orbit.mp4")) as first,
        server.dial(request(path + "orbit.mp4")) as again,
    ):
        eventually(lambda: making(server, id)[:1] and making(server, id)[0]["share"] == 0.5)
        with server.dial(request(path + "story.gif")) as second:
            eventually(lambda: len(making(server, id)) == 2)
            assert making(server, id) == [
                {"file": "orbit.mp4", "place": None, "share": 0.5},
                {"file": "story.gif", "place": 0, "share": None},
            ]
            # Neither the same scene in another format nor the video of another scene waits.
            assert server.ask(f"{SCENES}/{id}/files/scene.glb").status == 200
            pid = int((server.jobs.folder / "pid").read_text())
            assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
            for waiting in (first, again, second):
                assert b" 404 " in answer_of(waiting)
    eventually(lambda: not is_alive(pid))
    other = finished(server, "photo.png")
    assert server.ask(f"{SCENES}/{other}/files/orbit.mp4").status == 200


def test_a_file_that_nobody_waits_for_any_more_is_given_up(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.jobs.ABANDONED_AFTER_S", 0.1)
    id = finished(server, "endless.png")
    target = request(f"/s3cret{SCENES}/{id}/files/orbit.mp4")
    with server.dial(target), server.dial(target) as patient:
        eventually(lambda: making(server, id)[:1] and making(server, id)[0]["share"])
        pid = int((server.jobs.folder / "pid").read_text())
        with server.dial(target) as third:
            third.settimeout(0.3)
            with contextlib.suppress(TimeoutError):
                third.recv(1)
        assert (len(making(server, id)), is_alive(pid)) == (1, True)  # others still wait
        del patient
    eventually(lambda: making(server, id) == [])
    eventually(lambda: not is_alive(pid))


def test_a_file_has_a_limit_of_time(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    id = finished(server, "endless.png")
    monkeypatch.setattr(server.jobs, "limits", RetentionLimits(work_s=0.5))
    reply = server.ask(f"{SCENES}/{id}/files/orbit.mp4")
    assert reply.status == 500
    assert reply.json["error"] == "orbit.mp4: took longer than 0.5 seconds, the limit"


@needs_proc
def test_a_scene_and_a_file_of_it_may_take_so_much_memory(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = "needs more memory than it may take"
    id = finished(server, "hungry.png")
    with monkeypatch.context() as patch:
        patch.setattr("spackle.web.jobs.machine_memory", lambda: HUNGER_BYTES)
        reply = server.ask(f"{SCENES}/{id}/files/scene.glb")
        assert (reply.status, reply.json["error"]) == (500, f"scene.glb: {line}")
        again = server.send(name="hungry.png").json["id"]
        assert server.events(again)[-1]["error"] == f"hungry.png: {line}"
    # The process that makes scenes lives on, without the limit.
    assert finished(server, "hungry.png")


def test_a_photo_whose_worker_was_killed_is_tried_once_more(server: Served) -> None:
    assert finished(server, "once.png")


def test_on_a_full_disk_a_photo_is_kept_and_tried_again(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.jobs.RETRY_S", 0.2)
    flag = server.jobs.folder / "full"
    flag.touch()
    id = server.send(name="full.png").json["id"]
    eventually(lambda: server.ask(f"{SCENES}/{id}").json["line"])
    state = server.ask(f"{SCENES}/{id}").json
    assert (state["error"], state["ended"]) == (None, None)
    assert "disk full" in state["line"]
    assert list((server.jobs.folder / id).glob("source*"))
    flag.unlink()
    assert server.events(id)[-1]["state"] == "done"

    # A file that was asked for is not the scene's fault, either.
    flag.touch()
    reply = server.ask(f"{SCENES}/{id}/files/scene.glb")
    flag.unlink()
    assert (reply.status, set(reply.headers) >= WANTED_HEADERS) == (507, True)
    assert server.ask(f"{SCENES}/{id}/files/scene.glb").status == 200


def test_a_scene_is_done_when_the_disk_says_so_and_not_before(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.jobs.RETRY_S", 0.2)
    save = Job.save
    refused = []

    def save_at_second_time(job: Job) -> None:
        if job.ended is not None and not refused:
            refused.append(job.id)
            raise InputError(f"{job.folder}: cannot write") from NO_SPACE
        save(job)

    monkeypatch.setattr(Job, "save", save_at_second_time)
    id = server.send().json["id"]
    states = server.events(id)
    assert refused == [id]
    assert states[-1]["state"] == "done"
    record = Job.model_validate_json((server.jobs.folder / id / "job.json").read_bytes())
    assert (record.state, record.ended) == ("done", states[-1]["ended"])
    assert [state["state"] for state in states if state["ended"]] == ["done"]


@pytest.mark.parametrize("place", ["upload", "record", "folder"])
def test_a_full_disk_at_an_upload_is_507_with_all_headers_and_leaves_nothing(
    server: Served, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    def refuse(*arguments: Any) -> None:
        raise InputError(f"{server.jobs.folder}: cannot write") from NO_SPACE

    before = set(server.jobs.folder.iterdir())
    names = {
        "upload": "spackle.web.uploads.store_upload",
        "record": "spackle.web.jobs.write_json",
        "folder": "spackle.web.jobs.Jobs.reserve_place",
    }
    with monkeypatch.context() as patch:
        patch.setattr(names[place], refuse)
        reply = server.send()
    assert reply.status == 507
    assert reply.json["error"].startswith("the server cannot store this now (No space left")
    assert set(reply.headers) >= WANTED_HEADERS
    assert str(server.jobs.folder) not in reply.json["error"]
    assert set(server.jobs.folder.iterdir()) == before


def test_a_slow_disk_holds_up_nobody(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    changes_in_loop: list[str] = []
    change_count = 0

    def watched(name: str) -> Callable[..., Any]:
        """A function of `os`, which notes whether an event loop waits for it."""
        change = getattr(os, name)

        def note(*arguments: Any, **options: Any) -> Any:
            nonlocal change_count
            change_count += 1
            with contextlib.suppress(RuntimeError):
                asyncio.get_running_loop()
                changes_in_loop.append(f"{name} {arguments[0]}")
            return change(*arguments, **options)

        return note

    for name in ("mkdir", "rename", "replace", "rmdir", "unlink"):
        monkeypatch.setattr(os, name, watched(name))
    id = finished(server, "photo.png")
    assert server.ask(f"{SCENES}/{id}/files/scene.glb").status == 200
    assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
    assert server.send(b"no photo").status == 415
    assert change_count > 5
    assert changes_in_loop == []


def test_a_fault_of_the_server_leaves_by_the_same_door(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> None:
        raise RuntimeError("of /a/b/c")

    with monkeypatch.context() as patch:
        patch.setattr("spackle.web.uploads.store_upload", fail)
        reply = server.send()
    assert (reply.status, set(reply.headers) >= WANTED_HEADERS) == (500, True)
    assert "/a/b" not in reply.json["error"]


def test_no_path_of_the_server_leaves(server: Served) -> None:
    id = server.send(name="path.png").json["id"]
    assert server.events(id)[-1]["error"] == "'source.png': no photo"
    for line, expected in {
        "/home/a/b.png: bad": "b.png: bad",
        "cannot write '/tmp/x': full": "cannot write 'x': full",
        "C:\\Users\\me\\a.png: bad": "a.png: bad",
        "1/2 of it, and/or https://a.example/b/c": "1/2 of it, and/or https://a.example/b/c",
    }.items():
        assert without_folders(line) == expected


def test_a_record_that_is_saved_while_its_scene_is_deleted_brings_nothing_back(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    id = finished(server, "photo.png")
    job = server.jobs.by_id[id]
    remove_folder = os.rmdir
    late_saves = []

    def save_then_remove(path: Any, **options: Any) -> None:
        if str(path).endswith(id):
            late_saves.append(id)
            with contextlib.suppress(InputError, OSError):
                job.save()
        remove_folder(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rmdir", save_then_remove)
        assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
    assert late_saves
    assert not [path for path in server.jobs.folder.iterdir() if id in path.name]


def test_forms_are_utf_8(server: Served) -> None:
    for kind in (
        f"multipart/form-data; boundary={BOUNDARY}; charset=punycode",
        "application/x-www-form-urlencoded",
        "text/plain",
    ):
        reply = server.ask(SCENES, "POST", form(), Content_Type=kind)
        assert (reply.status, "UTF-8" in reply.json["error"]) == (400, True)
    kind = f"multipart/form-data; boundary={BOUNDARY}; charset=UTF-8"
    assert server.ask(SCENES, "POST", form(), Content_Type=kind).status == 202


def test_a_body_with_two_lengths_is_refused(server: Served) -> None:
    body = form()
    chunked = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
    status, answer = server.raw(post(len(body), "Transfer-Encoding: chunked") + chunked)
    assert (status, b"Transfer-Encoding" in answer) == (400, True)


def test_what_is_no_http_is_refused_with_all_headers(server: Served) -> None:
    with server.dial(b"\x16\x03\x01\r\n\r\n") as connection:
        head = answer_of(connection).partition(b"\r\n\r\n")[0].lower().decode()
    assert head.startswith("http/1.1 400")
    assert all(header in head for header in WANTED_HEADERS)


def test_a_silent_or_trickling_upload_gives_its_place_back(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(server.jobs.folder.iterdir())
    part_of_upload = post(90_000) + form()[:90]
    monkeypatch.setattr("spackle.web.guard.MAX_SILENCE_S", 0.4)
    with server.dial(part_of_upload) as silent:
        assert answer_of(silent).split()[1] == b"408"
    with server.dial(part_of_upload) as trickling:
        trickling.settimeout(0.05)
        answer = b""
        while not answer:
            with contextlib.suppress(TimeoutError, ConnectionError):
                trickling.sendall(b"x")
                answer = trickling.recv(100)
        assert answer.split()[1] == b"408"
    eventually(lambda: set(server.jobs.folder.iterdir()) == before)


def test_idle_connections_keep_nobody_out(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.web.app.MAX_CONNECTIONS", 5)
    monkeypatch.setattr("spackle.web.app.MAX_HEAD_S", 1000)  # silence alone closes none
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(server.dial()) for _ in range(9)]
        for _ in range(3):
            assert server.ask().status == 200
        # The oldest one has made room.
        assert answer_of(idle[0]) == b""


def test_too_many_requests_at_a_time_are_refused_with_all_headers(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spackle.web.guard.MAX_REQUESTS", 0)
    reply = server.ask()
    assert (reply.status, set(reply.headers) >= WANTED_HEADERS) == (503, True)


def test_links_in_the_folder_of_scenes_are_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    (secret / "results").mkdir(parents=True)
    (secret / "results" / "scene.ply").write_text("secret")
    folder = tmp_path / "scenes"
    with served(folder) as server:
        id = finished(server, "photo.png")
        (folder / id / "results" / "scene.spz").symlink_to(secret / "results" / "scene.ply")
        assert server.ask(f"{SCENES}/{id}/files/scene.spz").status == 404
    job = Job(id="0123456789abcdef", name="a", state="done", source="s", ended=time.time())
    (secret / "job.json").write_text(job.model_dump_json())
    (folder / job.id).symlink_to(secret)
    with served(folder) as server:
        assert server.ask(f"{SCENES}/{job.id}/files/scene.ply").status == 404
        assert set(server.jobs.by_id) == {id}
    assert (secret / "results" / "scene.ply").exists()
