"""What clients and operators of a busy server ask: is it ready, who waits, which scenes exist."""

from __future__ import annotations

import gc
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi import FastAPI
from helpers.command import run
from helpers.web_client import PHOTO, SCENES, Served, eventually, form, served

import spackle
from spackle.runtime.errors import InputError
from spackle.web.jobs import RetentionLimits, SceneState
from spackle.web.local_server import answer_requests
from spackle.web.public_address import PublicAddress


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes")) as server:
        yield server


def test_strangers_learn_that_the_server_runs_and_clients_its_version(server: Served) -> None:
    assert Served(server.port).ask("/healthz").json == {"status": "ok"}
    assert server.ask("/healthz").json == {"status": "ok", "version": spackle.__version__}


def test_the_server_is_ready_when_a_worker_runs_and_the_disk_has_space(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    stranger = Served(server.port)
    eventually(lambda: stranger.ask("/readyz").status == 200)
    assert stranger.ask("/readyz").json == {"status": "ready"}
    monkeypatch.setattr(
        "spackle.web.jobs.shutil.disk_usage", lambda folder: SimpleNamespace(free=5_000_000)
    )
    reply = stranger.ask("/readyz")
    assert reply.status == 503
    assert reply.json["error"].endswith("is full: 5 MB are left")
    assert str(server.jobs.folder) not in reply.json["error"]


def test_a_waiting_photo_knows_its_place_in_the_queue(tmp_path: Path) -> None:
    with served(tmp_path) as server:
        slow = server.send(name="slow.png").json["id"]
        eventually(lambda: server.ask(f"{SCENES}/{slow}").json["stage"] == "base")
        sent = [server.send(name=f"{k}.png").json for k in range(3)]
        assert [state["place"] for state in sent] == [0, 1, 2]
        assert server.ask(f"{SCENES}/{slow}").json["place"] is None

        # One before it goes away, so it comes nearer.
        assert server.ask(f"{SCENES}/{sent[1]['id']}", "DELETE").status == 204
        assert server.ask(f"{SCENES}/{sent[2]['id']}").json["place"] == 1
        assert server.ask(f"{SCENES}/{slow}", "DELETE").status == 204
        told = server.events(sent[2]["id"])
        assert told[-1]["state"] == "done"
        assert told[-1]["place"] is None


def test_a_photo_that_takes_too_long_fails_and_the_next_one_begins(tmp_path: Path) -> None:
    with served(tmp_path, keep=RetentionLimits(work_s=60)) as server:
        # Once the worker runs, the limit may be short.
        assert server.events(server.send().json["id"])[-1]["state"] == "done"
        server.jobs.limits = RetentionLimits(work_s=1)
        slow = server.events(server.send(name="slow.png").json["id"])[-1]
        assert slow["state"] == "failed"
        assert slow["error"] == "slow.png: took longer than 1 seconds, the limit"
        server.jobs.limits = RetentionLimits(work_s=60)
        assert server.events(server.send().json["id"])[-1]["state"] == "done"


def test_no_collection_of_garbage_looks_through_imported_modules_while_a_server_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passed_over: list[int] = []

    class Server:
        def run(self, sockets: list[socket.socket]) -> None:
            passed_over.append(gc.get_freeze_count())

    monkeypatch.setattr("spackle.web.local_server.make_server", lambda app: Server())
    with socket.socket() as listener:
        answer_requests(FastAPI(), listener)
    assert passed_over[0] > 100_000
    assert gc.get_freeze_count() == 0


def test_the_command_without_options_has_the_limits_of_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits: list[RetentionLimits] = []

    def note_limits(*arguments: object) -> None:
        limits.extend(value for value in arguments if isinstance(value, RetentionLimits))

    monkeypatch.setattr("spackle.web.local_server.serve_programs", note_limits)
    run("serve")
    assert limits == [RetentionLimits()]


def test_all_scenes_are_listed_in_pages_the_newest_first(tmp_path: Path) -> None:
    with served(tmp_path) as server:
        sent = [server.send(name=f"{k}.png").json["id"] for k in range(5)]
        newest_first = sent[::-1]

        def page(query: str) -> tuple[list[str], Any]:
            answer = server.ask(f"{SCENES}?{query}").json
            return [state["id"] for state in answer["scenes"]], answer["next"]

        assert page("") == (newest_first, None)
        assert set(server.ask(SCENES).json["scenes"][0]) == set(SceneState.model_fields)
        ids, mark = page("limit=2")
        assert ids == newest_first[:2]
        # Neither a deletion nor a newer photo moves the pages that follow.
        assert server.ask(f"{SCENES}/{ids[1]}", "DELETE").status == 204
        server.send(name="later.png")
        ids, mark = page(f"limit=2&after={mark}")
        assert ids == newest_first[2:4]
        assert page(f"limit=2&after={mark}") == (newest_first[4:], None)
        for query in ("limit=0", "limit=101", "limit=x", "after=x", "after=-"):
            reply = server.ask(f"{SCENES}?{query}")
            assert (reply.status, query.partition("=")[0] in reply.json["error"]) == (422, True)
    with served(tmp_path / "open", token=None) as free:
        assert free.ask(SCENES).status == 401  # who may only look must know an id


def test_a_repeated_request_with_its_key_makes_no_second_scene(tmp_path: Path) -> None:
    with served(tmp_path) as server:

        def send(key: str, path: str = SCENES) -> Any:
            return server.ask(path, "POST", form(PHOTO), Idempotency_Key=key)

        first = send("order 7")
        again = send("order 7")
        assert (first.status, again.status) == (202, 202)
        assert first.json["id"] == again.json["id"]
        assert first.headers["location"] == again.headers["location"]
        other = send("order 8").json["id"]
        assert other != first.json["id"]
        assert server.events(other)[-1]["state"] == "done"

        # A refused request takes no key, and a key belongs to one kind of request.
        assert server.ask(SCENES, "POST", form(b"x"), Idempotency_Key="order 9").status == 415
        assert send("order 9").status == 202
        assert send("order 7", f"{SCENES}/{other}/fill").status == 422
        assert "idempotency_key" not in server.ask(f"{SCENES}/{other}").json

    # The key outlives the server, and ends with the scene.
    with served(tmp_path) as server:
        reply = server.ask(SCENES, "POST", form(PHOTO), Idempotency_Key="order 8")
        assert reply.json["id"] == other
        assert server.ask(f"{SCENES}/{other}", "DELETE").status == 204
        reply = server.ask(SCENES, "POST", form(PHOTO), Idempotency_Key="order 8")
        assert reply.json["id"] != other


def test_pages_of_an_admitted_site_and_of_no_other_use_the_interface(tmp_path: Path) -> None:
    gallery = "https://gallery.example.com"
    public = PublicAddress(page_origins=(gallery,))
    with served(tmp_path, public=public) as server:
        from_page = {"Origin": gallery, "Sec_Fetch_Site": "cross-site"}

        # The browser asks first, without the token, what the page may send.
        bare = Served(server.port)
        question = bare.ask(SCENES, "OPTIONS", Access_Control_Request_Method="POST", **from_page)
        assert (question.status, question.body) == (204, b"")
        assert question.headers["access-control-allow-origin"] == gallery
        assert "Authorization" in question.headers["access-control-allow-headers"]
        assert "access-control-allow-credentials" not in question.headers

        reply = bare.ask(SCENES, Authorization="Bearer s3cret", **from_page)
        assert reply.status == 200
        assert reply.headers["access-control-allow-origin"] == gallery
        assert (reply.headers["vary"], reply.headers["x-frame-options"]) == ("Origin", "DENY")
        assert bare.ask(SCENES, **from_page).status == 401  # the token is still needed
        assert bare.ask(SCENES, Host="evil.example", **from_page).status == 403

        for origin in ("https://evil.example", f"{gallery}.evil.example", "null", gallery + ":1"):
            other = {**from_page, "Origin": origin}
            for method in ("GET", "OPTIONS"):
                refused = server.ask(SCENES, method, Access_Control_Request_Method="GET", **other)
                assert refused.status == 403
                assert "access-control-allow-origin" not in refused.headers
    for bad in ("*", "gallery.example.com", "https://gallery.example.com/", "null"):
        with pytest.raises(InputError, match="cors"):
            PublicAddress(page_origins=(bad,))


def test_prometheus_reads_numbers_of_photos_work_and_answers(tmp_path: Path) -> None:
    parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is missing")
    with served(tmp_path) as server:

        def numbers() -> dict[tuple[str, ...], float]:
            reply = server.ask("/metrics")
            assert reply.headers["content-type"].startswith("text/plain; version=0.0.4")
            families = parser.text_string_to_metric_families(reply.body.decode())
            samples = [sample for family in families for sample in family.samples]
            return {(each.name, *each.labels.values()): each.value for each in samples}

        for name in ("a.png", "b.png", "bad.png"):
            assert server.events(server.send(name=name).json["id"])[-1]["ended"]
        assert Served(server.port).ask("/metrics").status == 401
        server.raw(b"STRANGE / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        found = numbers()
        assert found["spackle_scenes", "done"] == 2
        assert found["spackle_scenes", "failed"] == 1
        assert found["spackle_scenes", "queued"] == 0
        assert found["spackle_work_seconds_count", "done"] == 2
        assert found["spackle_work_seconds_sum", "done"] > 0
        assert found["spackle_work_seconds_count", "failed"] == 1
        assert found["spackle_http_answers_total", "POST", "202"] == 3
        assert found["spackle_http_answers_total", "GET", "401"] == 1
        assert found["spackle_http_answers_total", "other", "401"] == 1
        assert found["spackle_queue_limit",] == 32
        assert found["spackle_disk_free_bytes",] > 0
        assert numbers()["spackle_http_answers_total", "GET", "200"] > 0


def test_without_the_package_the_server_says_how_to_get_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with served(tmp_path) as server:
        reply = server.ask("/metrics")
        assert (reply.status, "pip install" in reply.json["error"]) == (404, True)
