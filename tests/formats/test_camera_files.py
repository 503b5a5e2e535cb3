"""Camera and path files: round trips and everything that is not a camera or a path."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from spackle.camera_path import Keyframe
from spackle.errors import InputError
from spackle.formats import load_cameras, load_path

FRAME = {
    "K": [[500, 0, 320.0], [0, 510.5, 240], [0, 0, 1]],
    "world_to_camera": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]],
}
CAMERAS: dict[str, Any] = {"width": 640, "height": 480, "frames": [FRAME]}
FIRST, SECOND = (
    {"time": 0, "eye": [0, 0, 0], "target": [0, 0, 3]},
    {"time": 1.5, "eye": [0.2, 0, 0], "target": [0, 0, 3]},
)
PATH: dict[str, Any] = {"keyframes": [FIRST, SECOND]}


def changed(content: dict[str, Any], *keys: Any, to: Any) -> dict[str, Any]:
    """The content with another value, or without one where `to` is `...`, at a place in it."""
    content = target = copy.deepcopy(content)
    for key in keys[:-1]:
        target = target[key]
    if to is ...:
        del target[keys[-1]]
    else:
        target[keys[-1]] = to
    return content


def at(name: str, row: int, column: int, value: Any) -> dict[str, Any]:
    return changed(CAMERAS, "frames", 0, name, row, column, to=value)


def key(name: str, value: Any) -> dict[str, Any]:
    return changed(PATH, "keyframes", 1, name, to=value)


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def refused(load: Callable[[Path], object], path: Path, says: str) -> None:
    """In a message that begins with the file's name."""
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)


def test_reads_the_documented_format(tmp_path: Path) -> None:
    small = FRAME | {"width": 100, "height": 50}
    first, second = load_cameras(write(tmp_path / "c.json", CAMERAS | {"frames": [FRAME, small]}))
    assert (first.width, first.height, second.width, second.height) == (640, 480, 100, 50)
    assert first.K.dtype == first.world_to_camera.dtype == torch.float32
    assert first.K.tolist() == FRAME["K"]
    assert first.position.tolist() == [-0.5, 0, 2]
    assert torch.equal(first.world_to_camera, torch.tensor(FRAME["world_to_camera"]))
    assert load_cameras(write(tmp_path / "c.json", {"frames": [small]}))[0].width == 100
    assert len(load_cameras(write(tmp_path / "c.json", at("world_to_camera", 0, 0, 1.0003)))) == 1  # nearly rigid


def test_a_path_file_is_read(tmp_path: Path) -> None:
    keys = [FIRST, SECOND | {"up": [0, -1, 0.1], "fov": 50}]
    path = load_path(write(tmp_path / "p.json", {"keyframes": keys, "closed": True, "unit": "disparity"}))
    assert path.keys == (
        Keyframe(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
        Keyframe(1.5, (0.2, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.1), 50.0),
    )
    assert (path.closed, path.unit) == (True, "disparity")


BAD: list[tuple[Any, str]] = [
    ("", "empty"),
    ("[" * 100_000, "not JSON"),
    ([], 'needs a list "frames"'),
    (changed(CAMERAS, "frames", to=[0] * 10_001), "too many"),
    (changed(CAMERAS, "frames", to=[3]), "frame 0: must be an object"),
    (changed(CAMERAS, "frames", 0, "K", to=None), "frame 0: K must be a list"),
    (at("K", 0, 2, True), "K must be a list"),
    (at("K", 0, 2, math.nan), "finite"),
    (at("K", 0, 0, 1e300), "must stay below"),  # infinite in single precision
    (at("world_to_camera", 0, 3, -1e39), "must stay below"),
    (at("K", 1, 1, 1e-300), "positive focal lengths"),  # zero in single precision
    (at("K", 0, 2, 10**400), "finite"),
    (at("K", 0, 0, 0), "focal"),
    (at("K", 2, 2, 2), "last row of K"),
    (at("K", 0, 1, 3), "skew"),
    (at("world_to_camera", 0, 0, 1.01), "rotation"),
    (at("world_to_camera", 0, 0, -1), "rotation"),
    (at("world_to_camera", 3, 2, 0.5), "last row of world_to_camera"),
    (changed(CAMERAS, "width", to=0), "width"),
]
BAD_PATHS: list[tuple[Any, str]] = [
    (changed(PATH, "keyframes", to={}), 'needs a list "keyframes"'),
    (changed(PATH, "keyframes", to=[FIRST]), "two keyframes, got 1"),
    (changed(PATH, "keyframes", to=[0] * 10_001), "too many"),
    (PATH | {"loop": 1}, "unknown name 'loop'"),
    (PATH | {"closed": 1}, '"closed" must be'),
    (PATH | {"unit": "feet"}, '"unit" must be'),
    (key("eye", [math.nan, 0, 0]), 'keyframe 1: "eye" must hold finite numbers'),
    (key("eye", ["left", 0, 0]), "keyframe 1: \"eye\" must hold finite numbers, at most a million, not 'left'"),
    (key("target", [0, 0]), '"target" must be a list of three'),
    (key("eye", ...), 'keyframe 1: must be an object with "time", "eye"'),
    (key("roll", 3), "keyframe 1: unknown name 'roll'"),
    (key("target", [0.2, 0, 0]), "keyframe 1: eye and target coincide"),
    (key("up", [0.2, 0, -3]), "keyframe 1: up lies along the view"),
    (key("up", [0, 0, 0]), "keyframe 1: up has no length"),
    (key("fov", 179), "keyframe 1: fov must be from 1 to 170"),
    (key("time", 0), "times must increase, by a microsecond at least: keyframe 1 is at 0 s"),
    ('{"keyframes": [], "keyframes": []}', "'keyframes' is there twice"),
]


@pytest.mark.parametrize(("content", "says"), BAD, ids=[says for _, says in BAD])
def test_a_bad_camera_file_is_refused_with_the_reason(tmp_path: Path, content: Any, says: str) -> None:
    refused(load_cameras, write(tmp_path / "c.json", content), says)


@pytest.mark.parametrize(("content", "says"), BAD_PATHS, ids=[says for _, says in BAD_PATHS])
def test_a_bad_path_file_is_refused_with_the_reason(tmp_path: Path, content: Any, says: str) -> None:
    refused(load_path, write(tmp_path / "p.json", content), says)


@pytest.mark.parametrize(("load", "kind"), [(load_cameras, "camera file"), (load_path, "path file")])
def test_files_that_are_not_there_or_not_text(tmp_path: Path, load: Callable[[Path], object], kind: str) -> None:
    path = tmp_path / "c.json"
    refused(load, path, f"no such {kind}")
    path.write_bytes(b"\xff\xfe\x00{")
    refused(load, path, "not JSON")
    with open(path, "wb") as sparse:
        sparse.truncate(1 << 30)
    refused(load, path, f"too long for a {kind}")
