"""Scenes that a running server has opened, for tests of edits."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from helpers.things_in_rooms import Room, room, sphere
from helpers.web_client import Served
from spackle.formats import save_ply


def opened_scene(server: Served, file: Path) -> str:
    """The id of a scene that the server has opened from a file."""
    with server.jobs.reserve_place() as folder:
        job = server.jobs.add(folder, file.name, str(file.resolve()), None, {"files": []})
    assert server.events(job.id)[-1]["error"] is None
    return job.id


def scene_file(server: Served, id: str, name: str = "scene.ply") -> Path:
    """A file among the results of a scene."""
    return server.jobs.folder / id / "results" / name


def ball_and_wall(folder: Path) -> tuple[Room, Path]:
    """A ball in front of a wall, which nobody has seen behind the ball, and its file."""
    whole = room(sphere((0, 0, 3), 0.5, 0.05), floor_height=None, pitch=0, spacing=0.05)
    wall = whole.background
    # The ball's shadow on the wall at 5 m has a radius of 0.845 m.
    wall = wall.select(wall.means[:, :2].norm(dim=-1) > 0.8)
    some = dataclasses.replace(whole, background=wall)
    save_ply(some.scene, folder / "room.ply", camera=some.camera)
    return some, folder / "room.ply"
