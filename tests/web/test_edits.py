"""Edits of finished scenes over HTTP: holes of views are filled, marked things are taken out."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.photos import read_ply
from helpers.scenes import box_before_wall, shifted
from helpers.web_client import SCENES, Reply, Served, form, served
from helpers.web_scenes import ball_and_wall, opened_scene, scene_file
from PIL import Image
from torch import Tensor

from spackle.core.camera import Camera
from spackle.formats import load_ply, save_ply
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio
from spackle.web.work import SceneWork

CPU = CpuRenderer()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("scenes"), work=SceneWork()) as server:
        yield server


def as_json(camera: Camera) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "world_to_camera": camera.world_to_camera.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def png(mask: Tensor) -> bytes:
    Image.fromarray(mask.numpy().astype(np.uint8) * 255).save(file := io.BytesIO(), "PNG")
    return file.getvalue()


def post(server: Served, id: str, what: str, options: Any, **files: bytes) -> Reply:
    """The answer to a form with options, and files without a photo."""
    fields = {name: (f"{name}.png", content) for name, content in files.items()}
    body = form(b"", options=json.dumps(options), **fields)
    _, _, without_photo = body.partition(b"--7d1\r\n")[2].partition(b"--7d1\r\n")
    return server.ask(f"{SCENES}/{id}/{what}", "POST", b"--7d1\r\n" + without_photo)


def edited(server: Served, reply: Reply) -> str:
    """The id of the scene that an edit has made."""
    assert reply.status == 202, reply.body
    id: str = reply.json["id"]
    assert server.events(id)[-1]["error"] is None
    return id


def page_of(server: Served, id: str) -> Any:
    return server.ask(f"{SCENES}/{id}/files/page.json").json


def test_a_scene_is_filled_where_views_are_open(server: Served, tmp_path: Path) -> None:
    box = box_before_wall(width=64, height=48, focal=53)
    save_ply(box.base(), tmp_path / "box.ply", camera=box.camera)
    id = opened_scene(server, tmp_path / "box.ply")
    views = [box.camera, shifted(box.camera, 0.3), shifted(box.camera, 0.6)]
    reply = post(server, id, "fill", {"cameras": [as_json(view) for view in views]})
    assert (reply.json["parent"], reply.json["edit"], reply.json["name"]) == (id, "fill", "box.ply")
    child = edited(server, reply)
    report = server.ask(f"{SCENES}/{child}/files/report.json").json
    assert (report["edit"], report["removed"]) == ("fill", 0)
    # The rows of the scene keep their bytes, and its own file did not change.
    before, after = (read_ply(scene_file(server, each)) for each in (id, child))
    assert after.body.startswith(before.body)
    assert after.count == before.count + report["added"]
    holes = [
        hole_area_ratio(CPU.render(load_ply(scene_file(server, child)), v).alpha) for v in views
    ]
    assert report["before"] > 0.05
    assert max(holes) < 0.002
    assert report["after"] == pytest.approx(holes[-1])
    # The page goes on where it was.
    former, page = page_of(server, id), page_of(server, child)
    assert [layer["count"] for layer in page["layers"]] == [before.count, report["added"]]
    for item in ("camera", "focus", "zNear", "orbit", "paths", "name", "note"):
        assert page[item] == former[item]
    assert "removed.ply" not in server.ask(f"{SCENES}/{child}").json["files"]
    assert server.ask(f"{SCENES}/{child}/files/removed.ply").status == 404
    assert not (server.jobs.folder / child / "source.ply").exists()
    # An edit of an edit, after its parent was deleted; where nothing is open, nothing is added.
    assert server.ask(f"{SCENES}/{id}", "DELETE").status == 204
    again = edited(server, post(server, child, "fill", {"cameras": [as_json(views[1])]}))
    assert server.ask(f"{SCENES}/{again}/files/report.json").json["added"] == 0
    assert server.ask(f"{SCENES}/{again}/files/scene.spz").body[:2] == b"\x1f\x8b"
    assert read_ply(scene_file(server, again)).body.startswith(after.body)


def test_a_marked_thing_is_taken_out_and_what_it_hid_is_filled(
    server: Served, tmp_path: Path
) -> None:
    ball, file = ball_and_wall(tmp_path)
    id = opened_scene(server, file)
    child = edited(
        server,
        post(
            server,
            id,
            "remove",
            {"camera": as_json(ball.camera)},
            mask=png(ball.mask()),
        ),
    )
    report = server.ask(f"{SCENES}/{child}/files/report.json").json
    assert server.ask(f"{SCENES}/{child}").json["edit"] == "remove"
    # What stays keeps its bytes: first the edit alone, then the edit and the patch.
    rows = [
        np.frombuffer(read_ply(path).body, np.uint8).reshape(read_ply(path).count, -1)
        for path in (
            scene_file(server, id),
            scene_file(server, child, "removed.ply"),
            scene_file(server, child),
        )
    ]
    assert len(rows[0]) == len(rows[1]) + report["removed"]
    assert len(rows[2]) == len(rows[1]) + report["added"]
    assert np.array_equal(rows[2][: len(rows[1])], rows[1])
    kept = {row.tobytes() for row in rows[0]}
    assert all(row.tobytes() in kept for row in rows[1])
    assert abs(report["removed"] - len(ball.thing)) < 0.05 * len(ball.thing)
    assert report["after"] < 0.002
    removed = server.ask(f"{SCENES}/{child}/files/removed.ply")
    assert removed.body == scene_file(server, child, "removed.ply").read_bytes()


@pytest.mark.parametrize(
    ("what", "options", "status", "why"),
    [
        ("fill", {}, 422, "options: cameras: field required"),
        ("fill", {"cameras": []}, 422, "cameras"),
        ("fill", {"cameras": [{}]}, 422, "cameras.0.K"),
        ("fill", {"views": 3}, 422, "cameras"),
        ("fill", "large", 422, "too many pixels"),
        ("fill", "mirror", 422, "cameras.0: world_to_camera must be a rotation"),
        ("remove", {}, 422, "camera: field required"),
        ("remove", "no mask", 422, "`mask`"),
        ("remove", "no picture", 415, "mask: not an image"),
        ("remove", "other size", 415, "mask: the mask has 10×10 pixels, and its camera has 64×48"),
        ("remove", "black", 415, "mask: the mask marks nothing"),
    ],
)
def test_impossible_edits_are_refused(
    server: Served, tmp_path: Path, what: str, options: Any, status: int, why: str
) -> None:
    box = box_before_wall(width=64, height=48, focal=53)
    save_ply(box.base(), tmp_path / "box.ply", camera=box.camera)
    id = opened_scene(server, tmp_path / "box.ply")
    before = set(server.jobs.folder.iterdir())
    camera = as_json(box.camera)
    mask = np.zeros((48, 64), bool)
    files: dict[str, bytes] = {}
    if options == "large":
        options = {"cameras": [camera | {"width": 3000, "height": 2000}]}
    elif options == "mirror":
        mirror = np.diag([-1.0, 1, 1, 1]).tolist()
        options = {"cameras": [camera | {"world_to_camera": mirror}]}
    elif isinstance(options, str):
        sizes = {"other size": np.ones((10, 10), bool), "black": mask}
        if options != "no mask":
            chosen = sizes.get(options)
            files["mask"] = b"no" if chosen is None else png(torch.from_numpy(chosen))
        options = {"camera": camera}
    reply = post(server, id, what, options, **files)
    assert (reply.status, why in reply.json["error"]) == (status, True), reply.body
    assert set(server.jobs.folder.iterdir()) == before


def test_a_mask_that_marks_nothing_fails_in_a_line(server: Served, tmp_path: Path) -> None:
    ball, file = ball_and_wall(tmp_path)
    id = opened_scene(server, file)
    far = ball.camera.looking(ball.camera.position, ball.camera.position.new_tensor([0, 0, -9.0]))
    nearly_all = ball.mask() | True
    nearly_all[0, 0] = False
    mask = png(nearly_all)
    reply = post(server, id, "remove", {"camera": as_json(far)}, mask=mask)
    (error,) = {state["error"] for state in server.events(reply.json["id"])[-1:]}
    assert "paint over the whole thing" in error
    assert post(server, reply.json["id"], "fill", {"cameras": [as_json(far)]}).status == 409
