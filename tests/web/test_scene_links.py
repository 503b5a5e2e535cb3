"""Links to single scenes, for somebody who has no token."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from helpers.browser import drag_moves_the_eye, opened, settled
from helpers.scenes import box_before_wall
from helpers.web_client import SCENES, Reply, Served, request, served
from PIL import Image

from spackle.core.trajectories import trajectory_cameras
from spackle.pipeline import complete
from spackle.web.clients import Client
from spackle.web.public_address import PublicAddress

CAPTION = 'Grandma\'s "best" <hat> & $& coat'


@pytest.fixture(scope="module")
def page_of_a_box() -> bytes:
    """The page of a small scene, as a file."""
    prediction = box_before_wall(width=64, height=48, focal=53).lift()
    cameras = trajectory_cameras("swipe", prediction.camera.even(), 0.3, prediction.depth_range, 2)
    return complete(prediction, cameras, network=None).page_file("box.jpg", caption="")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("links")) as running:
        yield running


def finished(server: Served, page: bytes) -> str:
    """The id of a new scene that is done and whose page is there."""
    id: str = server.send().json["id"]
    assert server.events(id)[-1]["state"] == "done"
    (server.jobs.by_id[id].results / "scene.html").write_bytes(page)
    return id


def link(server: Served, id: str, caption: str = "") -> str:
    answer = server.ask(f"{SCENES}/{id}/link?caption={quote(caption)}")
    assert answer.status == 200
    path: str = answer.json["path"]
    return path


def without_token(server: Served, path: str, method: str = "GET") -> Reply:
    return Served(server.port).ask(path, method)


def test_who_has_a_link_sees_the_scene_and_nothing_else(
    server: Served, page_of_a_box: bytes
) -> None:
    id = finished(server, page_of_a_box)
    other = finished(server, page_of_a_box)
    path = link(server, id)
    assert "s3cret" not in path
    shown = without_token(server, path)
    assert shown.status == 200
    assert shown.headers["content-type"].startswith("text/html")
    assert "content-disposition" not in shown.headers  # it is opened, not saved
    assert shown.headers["x-robots-tag"] == "noindex"

    # Neither another scene, nor the interface, nor a change.
    assert without_token(server, path.replace(id, other)).status == 404
    assert without_token(server, f"/shared/{id}/{'0' * 32}/").status == 404
    assert without_token(server, f"{SCENES}/{id}").status == 401
    assert without_token(server, f"/shared/{id}{SCENES}").status == 404
    assert without_token(server, path, "DELETE").status == 405
    assert without_token(server, "/shared/../" + SCENES[1:]).status != 200


def test_programs_that_preview_a_link_find_its_picture(
    server: Served, page_of_a_box: bytes
) -> None:
    path = link(server, finished(server, page_of_a_box), CAPTION)
    page = without_token(server, path).body.decode()
    image = re.search(r'<meta property="og:image" content="([^"]+)">', page)
    assert image is not None
    address = f"http://127.0.0.1:{server.port}"
    assert image[1].startswith(f"{address}/shared/")
    preview = without_token(server, image[1].removeprefix(address))
    assert preview.status == 200
    assert Image.open(io.BytesIO(preview.body)).format == "JPEG"


def test_nobody_can_put_other_words_under_a_picture(server: Served, page_of_a_box: bytes) -> None:
    path = link(server, finished(server, page_of_a_box), CAPTION)
    assert without_token(server, path).status == 200
    assert without_token(server, path.partition("?")[0]).status == 404
    assert without_token(server, path.replace("Grandma", "Grandpa")).status == 404
    assert server.ask(f"{SCENES}/0/link?caption={'x' * 201}").status == 422


def test_a_link_opens_in_a_browser_with_its_caption(
    server: Served, page_of_a_box: bytes, browser: Any
) -> None:
    path = link(server, finished(server, page_of_a_box), CAPTION)
    found = opened(browser, f"http://127.0.0.1:{server.port}{path}")
    settled(found.page, "spackle.ready")
    assert found.page.locator("#caption").inner_text() == CAPTION
    drag_moves_the_eye(found.page)
    assert found.said == []
    found.page.context.close()


def test_a_link_ends_with_its_scene(server: Served, page_of_a_box: bytes) -> None:
    id = finished(server, page_of_a_box)
    path = link(server, id)
    assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
    assert without_token(server, path).status == 404
    assert server.ask(f"{SCENES}/{id}/link").status == 404


def test_a_scene_has_a_link_once_it_is_done(server: Served) -> None:
    id = server.send(name="slow.png").json["id"]
    assert server.ask(f"{SCENES}/{id}/link").status == 409
    assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204


def test_a_page_that_everybody_can_open_has_no_other_link(
    tmp_path: Path, page_of_a_box: bytes
) -> None:
    with served(tmp_path) as server:
        id = finished(server, page_of_a_box)
    with served(tmp_path, token=None) as server:
        assert server.ask(f"{SCENES}/{id}/link").json == {"path": None}
        assert server.ask(f"/shared/{id}/{'0' * 32}/").status == 404


def test_links_of_a_public_server_lead_through_its_proxy(
    tmp_path: Path, page_of_a_box: bytes
) -> None:
    public = PublicAddress(url="https://photos.example.com/studio")
    with served(tmp_path, public=public) as server:
        path = link(server, finished(server, page_of_a_box))
        assert path.startswith("/studio/shared/")
        seen_by_the_server = path.removeprefix("/studio")
        status, page = server.raw(request(seen_by_the_server, host="photos.example.com"))
        assert status == 200
        assert b'og:image" content="https://photos.example.com/studio/shared/' in page


def test_a_client_makes_links_to_its_own_scenes_alone(tmp_path: Path, page_of_a_box: bytes) -> None:
    clients = (Client(name="studio", token="a" * 16), Client(name="web", token="b" * 16))
    with served(tmp_path, clients=clients) as server:
        studio, web = (Served(server.port, f"/{client.token}", server.jobs) for client in clients)
        id = finished(studio, page_of_a_box)
        assert without_token(server, link(studio, id)).status == 200
        assert web.ask(f"{SCENES}/{id}/link").status == 404
