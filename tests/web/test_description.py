"""The description of the HTTP interface: whole, true to the answers, and enough for a generated
client.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import pytest
from helpers import web_work
from helpers.web_client import PHOTO, SCENES, Reply, Served, form, served

from spackle.web.app import Health, Readiness, ScenePage, create_app
from spackle.web.description import ErrorAnswer, operations
from spackle.web.jobs import RetentionLimits, SceneState

ONE = SCENES + "/{id}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes")) as server:
        yield server


@pytest.fixture(scope="module")
def description(server: Served) -> dict[str, Any]:
    found: dict[str, Any] = server.ask("/api/v1/openapi.json").json
    return found


def check_described(
    description: dict[str, Any], path: str, method: str, reply: Reply, status: int
) -> None:
    """Assert that an answer has this status, and that its status, kind and body are described."""
    assert reply.status == status, reply.body
    answer = description["paths"][path][method.lower()]["responses"][str(status)]
    assert answer["description"]
    assert set(answer.get("headers", {})) <= {name.title() for name in reply.headers}
    if "content" not in answer:
        assert not reply.body
        return
    kind = reply.headers["content-type"].partition(";")[0]
    assert kind in answer["content"]
    if status >= 400:
        assert answer["content"][kind]["schema"]["$ref"].endswith("/ErrorAnswer")
        ErrorAnswer.model_validate(reply.json)
    elif kind == "application/json" and "/files/" not in path:
        name = answer["content"][kind]["schema"]["$ref"].rpartition("/")[2]
        models = (SceneState, ScenePage, Health, Readiness)
        {model.__name__: model for model in models}[name].model_validate(reply.json)


def test_each_answer_is_described_with_its_status_and_body(
    server: Served, description: dict[str, Any], tmp_path: Path
) -> None:
    def check(status: int, path: str, method: str, reply: Reply) -> Reply:
        check_described(description, path, method, reply, status)
        return reply

    id = check(202, SCENES, "POST", server.send()).json["id"]
    assert server.events(id)[-1]["state"] == "done"
    bad = server.send(name="bad.png").json["id"]
    assert server.events(bad)[-1]["state"] == "failed"
    check(400, SCENES, "POST", server.send(b""))
    check(413, SCENES, "POST", server.send(bytes(200_000)))
    check(415, SCENES, "POST", server.send(b"no photo"))
    check(422, SCENES, "POST", server.send(options='{"disparity": 3}'))
    check(403, SCENES, "POST", server.ask(SCENES, "POST", form(), Host="evil.example"))
    check(401, SCENES, "POST", Served(server.port).send())

    check(200, SCENES, "GET", server.ask(SCENES))
    check(422, SCENES, "GET", server.ask(f"{SCENES}?limit=0"))
    for path in ("/healthz", "/readyz"):
        check(200, path, "GET", Served(server.port).ask(path))
        check(403, path, "GET", server.ask(path, Host="evil.example"))
    check(200, ONE, "GET", server.ask(f"{SCENES}/{id}"))
    check(404, ONE, "GET", server.ask(f"{SCENES}/none"))
    check(401, ONE, "GET", Served(server.port).ask(f"{SCENES}/{id}"))
    check(200, f"{ONE}/events", "GET", server.ask(f"{SCENES}/{id}/events"))
    for edit in ("fill", "remove"):
        for of, status in (("none", 404), (bad, 409), (id, 422)):
            reply = server.ask(f"{SCENES}/{of}/{edit}", "POST", form())
            check(status, f"{ONE}/{edit}", "POST", reply)

    files = f"{ONE}/files/{{file}}"
    for name in ("swipe.mp4", "scene.html", "scene.glb", "scene.ply", "photo.jpg", "page.json"):
        check(200, files, "GET", server.ask(f"{SCENES}/{id}/files/{name}"))
    check(404, files, "GET", server.ask(f"{SCENES}/{id}/files/passwd"))
    check(404, files, "GET", server.ask(f"{SCENES}/{id}/files/aux.splats"))
    check(409, files, "GET", server.ask(f"{SCENES}/{bad}/files/scene.ply"))
    check(204, ONE, "DELETE", server.ask(f"{SCENES}/{id}", "DELETE"))
    check(404, ONE, "DELETE", server.ask(f"{SCENES}/{id}", "DELETE"))

    with served(tmp_path, keep=RetentionLimits(waiting=0)) as full:
        check(429, SCENES, "POST", full.send())


def test_a_fault_of_the_server_is_answered_as_described(
    server: Served, description: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(job: object, place: object) -> None:
        raise KeyError("a secret")

    id = server.send().json["id"]
    monkeypatch.setattr("spackle.web.app.state_with_files", fail)
    reply = server.ask(f"{SCENES}/{id}")
    check_described(description, ONE, "GET", reply, 500)
    assert b"secret" not in reply.body
    assert reply.headers["x-content-type-options"] == "nosniff"


def test_the_description_names_the_token_the_values_and_examples(
    description: dict[str, Any], tmp_path: Path
) -> None:
    for operation in operations(description):
        needs_token = operation["operationId"] not in ("get_health", "get_readiness")
        assert operation["security"] == ([{"token": []}] if needs_token else [])
        assert {"403", "500"} < set(operation["responses"])
        assert ("401" in operation["responses"]) == needs_token
        assert re.fullmatch(r"[a-z_]+", operation["operationId"])
        for answer in operation["responses"].values():
            content = answer.get("content", {}).get("application/json", {})
            assert "$ref" not in content.get("schema", {}) or "example" in content
    scheme = description["components"]["securitySchemes"]["token"]
    assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")

    # Each reference leads somewhere, and nothing of FastAPI's own answers is left.
    text = json.dumps(description)
    schemas = description["components"]["schemas"]
    assert set(re.findall(r"#/components/schemas/(\w+)", text)) == set(schemas)
    assert {"SceneState", "SceneOptions", "FillRequest", "CameraEntry", "ErrorAnswer"} < set(
        schemas
    )
    assert "HTTPValidationError" not in text
    assert schemas["SceneState"]["properties"]["state"]["enum"] == [
        "queued",
        "running",
        "done",
        "failed",
    ]
    example = description["paths"][ONE]["get"]["responses"]["200"]["content"]["application/json"]
    assert {"id", "state", "files"} < set(example["example"])
    SceneState.model_validate(example["example"])

    # An app that another one mounts leaves access to it, and so knows no token.
    mounted = create_app(tmp_path, web_work.work)
    try:
        assert "token" not in json.dumps(mounted.openapi()["components"])
        assert not any(operation.get("security") for operation in operations(mounted.openapi()))
    finally:
        mounted.state.jobs.close()


@pytest.mark.parametrize("path", ["/docs", "/api/v1/docs"])
def test_the_page_about_the_interface_lists_answers_and_leads_to_its_files(
    server: Served, path: str
) -> None:
    page = server.ask(path).body.decode()
    assert all(word in page for word in ("429", "keep_frame", "world_to_camera", "cameras"))
    links = re.findall(r'href="([^"]+)"', page)
    assert len(links) == 2
    for link in links:
        assert server.ask(urljoin(path, link)).status == 200, link


CLIENT_PROGRAM = """
import io, sys, time
sys.path.insert(0, sys.argv[1])
from client import AuthenticatedClient
from client.api.scenes import delete_scene, get_file, get_state, post_photo
from client.models import ErrorAnswer, PostPhotoBody, SceneOptions, SceneOptionsTrajectory
from client.types import File

photo = open(sys.argv[3], "rb")
body = PostPhotoBody(
    photo=File(payload=photo, file_name="photo.png", mime_type="image/png"),
    options=SceneOptions(trajectory=SceneOptionsTrajectory.SWIPE, frames=3),
)
with AuthenticatedClient(base_url=sys.argv[2], token="s3cret") as client:
    state = post_photo.sync(client=client, body=body)
    while state.ended is None:
        time.sleep(0.05)
        state = get_state.sync(id=state.id, client=client)
    assert state.state == "done", state
    video = get_file.sync(id=state.id, file="swipe.mp4", client=client)
    assert video.payload.read() == b"swipe.mp4"
    assert delete_scene.sync_detailed(id=state.id, client=client).status_code == 204
    gone = get_state.sync(id=state.id, client=client)
    assert isinstance(gone, ErrorAnswer) and gone.error == "there is no such scene", gone
with AuthenticatedClient(base_url=sys.argv[2], token="wrong") as client:
    refused = get_state.sync(id=state.id, client=client)
    assert isinstance(refused, ErrorAnswer), refused
print("posted, waited, fetched, deleted")
"""


def test_a_generated_client_posts_waits_fetches_and_deletes(
    server: Served, description: dict[str, Any], tmp_path: Path
) -> None:
    python = os.environ.get("OPENAPI_CLIENT_PYTHON", sys.executable)
    has_generator = importlib.util.find_spec("openapi_python_client") is not None
    if python == sys.executable and not has_generator:
        pytest.skip(
            "openapi-python-client is missing: set OPENAPI_CLIENT_PYTHON to a Python that has it"
        )
    (tmp_path / "openapi.json").write_text(json.dumps(description))
    # The generator would tidy up with ruff, which may be missing.
    (tmp_path / "config.yaml").write_text("post_hooks: []\n")
    (tmp_path / "photo.png").write_bytes(PHOTO)
    generate = "generate --path openapi.json --config config.yaml --meta none --fail-on-warning"
    words = [python, "-m", "openapi_python_client", *generate.split(), "--output-path", "client"]
    subprocess.run(words, cwd=tmp_path, check=True)
    ran = subprocess.run(
        [python, "-c", CLIENT_PROGRAM, ".", f"http://127.0.0.1:{server.port}", "photo.png"],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
    )
    assert ran.stdout == "posted, waited, fetched, deleted\n"
