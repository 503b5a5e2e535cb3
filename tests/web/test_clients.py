"""Several clients of one server do not see each other, and have limits of their own."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from helpers import ROOT
from helpers.command import refuses, run
from helpers.web_client import SCENES, Served, form, served

from spackle.runtime.errors import InputError
from spackle.web import clients
from spackle.web.clients import Client, RateLimits, read_clients

STUDIO = Client("studio", "studio-token-0123456789")
OTHER = Client("other", "other-token-0123456789")
WEBSITE = Client("website", "website-token-0123456789", photos_per_hour=2)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes"), clients=(STUDIO, OTHER, WEBSITE)) as server:
        yield server


def of(client: Client, server: Served) -> Served:
    """The server as a client sees it."""
    return Served(server.port, f"/{client.token}")


def test_a_client_sees_and_changes_its_own_scenes_alone(server: Served) -> None:
    studio, website = of(STUDIO, server), of(WEBSITE, server)
    id = studio.send().json["id"]
    assert studio.events(id)[-1]["state"] == "done"
    scene = f"{SCENES}/{id}"
    for path, method in (
        (scene, "GET"),
        (f"{scene}/events", "GET"),
        (f"{scene}/files/base.splats", "GET"),
        (f"{scene}/fill", "POST"),
        (f"{scene}/remove", "POST"),
        (scene, "DELETE"),
    ):
        reply = website.ask(path, method, b"" if method == "POST" else None)
        assert (reply.status, reply.json) == (404, {"error": "there is no such scene"}), path
    own = studio.ask(scene)
    assert own.status == 200
    assert "client" not in own.json
    # As a header, and for the operator, who sees all.
    bearer = f"Bearer {STUDIO.token}"
    assert Served(server.port).ask(scene, Authorization=bearer).status == 200
    assert server.ask(scene).status == 200
    # The list names no scene of others.
    assert [state["id"] for state in studio.ask(SCENES).json["scenes"]] == [id]
    assert website.ask(SCENES).json["scenes"] == []
    assert [state["id"] for state in server.ask(SCENES).json["scenes"]] == [id]
    # Numbers, which are sums over all clients; 404 where the package for them is missing.
    assert website.ask("/metrics").status == 403
    assert server.ask("/metrics").status in (200, 404)
    assert studio.ask(scene, "DELETE").status == 204


def test_two_clients_may_use_the_same_key(server: Served) -> None:
    def send(client: Client) -> str:
        sent = of(client, server).ask(SCENES, "POST", form(), Idempotency_Key="first")
        return str(sent.json["id"])

    first = send(STUDIO)
    assert send(STUDIO) == first
    assert send(OTHER) != first


def test_a_strangers_token_is_none(server: Served) -> None:
    for token in ("", STUDIO.token[:-1], STUDIO.name, STUDIO.token.upper()):
        assert Served(server.port, f"/{token}").ask("/page.json").status == 401


def test_a_client_has_a_limit_of_its_own(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    website = of(WEBSITE, server)
    assert website.send(b"no photo").status == 415  # refused photos do not count
    assert [website.send().status for _ in range(2)] == [202, 202]
    full = website.send()
    assert (full.status, "2 photos in an hour" in full.json["error"]) == (429, True)
    assert 3500 < int(full.headers["retry-after"]) <= 3600
    assert of(STUDIO, server).send().status == 202
    monkeypatch.setattr(clients, "HOUR_S", 0.0)
    assert website.send().status == 202


def test_photos_that_arrive_at_the_same_time_count() -> None:
    rates = RateLimits([WEBSITE])
    refused = pytest.raises(Exception, match="2 photos in an hour")
    with rates.count_photo("website"), rates.count_photo("website"), refused:
        rates.count_photo("website").__enter__()


def test_the_log_has_no_token(server: Served, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, "spackle.web"):
        of(STUDIO, server).ask("/page.json")
    assert "GET /…/page.json 200" in caplog.text
    assert STUDIO.token not in caplog.text


def test_the_example_in_the_docs_is_read(tmp_path: Path) -> None:
    docs = (ROOT / "docs" / "http.md").read_text("utf-8")
    block = re.findall(r"```yaml\n(.*?)```", docs, re.DOTALL)[0]
    (tmp_path / "clients.yaml").write_text(block)
    found = read_clients(tmp_path / "clients.yaml")
    assert [(client.name, client.photos_per_hour) for client in found] == [
        ("studio", 100),
        ("website", None),
    ]
    tokens = [entry["token"] for entry in yaml.safe_load(block).values()]
    assert [client.token for client in found] == tokens


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("studio: {token: short}", "studio.token: not as expected"),
        ("studio: {token: 0123456789abcdef, limit: 3}", "studio.limit: not as expected"),
        ("studio: {token: 0123456789abcdef, photos_per_hour: 0}", "studio.photos_per_hour"),
        ("0123456789abcdef-SECRET: {token: 0123456789abcdef}", "a name: not as expected"),
        ("a: {token: 0123456789abcdef}\nb: {token: 0123456789abcdef}", "the same token"),
        ("{0123456789abcdef", "no YAML"),
        ("", "the file: not as expected"),
    ],
)
def test_a_bad_file_of_clients_is_refused_without_its_tokens(
    tmp_path: Path, text: str, says: str
) -> None:
    file = tmp_path / "clients.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=re.escape(says)) as refusal:
        read_clients(file)
    assert "0123456789abcdef" not in str(refusal.value)


def test_the_command_names_the_missing_file(tmp_path: Path) -> None:
    missing = tmp_path / "none.yaml"
    refuses(run("serve", "-o", tmp_path, "--clients", missing), f"--clients {missing}")
