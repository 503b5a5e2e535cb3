"""Camera and path files: round trips and everything that is not a camera or a path."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from spackle.camera_path import Keyframe
from spackle.errors import InputError
from spackle.formats import load_cameras, load_path

GOOD: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "frames": [
        {
            "K": [[500, 0, 320.0], [0, 510.5, 240], [0, 0, 1]],
            "world_to_camera": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]],
        }
    ],
}


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def refused(load: Callable[[Path], object], path: Path, says: str) -> None:
    """In a message that begins with the file's name."""
    with pytest.raises(InputError, match=says) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_reads_the_documented_format(tmp_path: Path) -> None:
    content = copy.deepcopy(GOOD)
    content["frames"].append(content["frames"][0] | {"width": 100, "height": 50})
    first, second = load_cameras(write(tmp_path / "c.json", content))
    assert (first.width, first.height, second.width, second.height) == (640, 480, 100, 50)
    assert first.K.dtype == first.world_to_camera.dtype == torch.float32
    assert first.K.tolist() == GOOD["frames"][0]["K"]
    assert first.position.tolist() == [-0.5, 0, 2]
    assert torch.equal(first.world_to_camera, torch.tensor(GOOD["frames"][0]["world_to_camera"]))
    del content["width"], content["frames"][0]
    assert load_cameras(write(tmp_path / "c.json", content))[0].width == 100
    assert len(load_cameras(write(tmp_path / "c.json", at("world_to_camera", 0, 0, 1.0003)))) == 1  # nearly rigid


def changed(path: list[Any], value: Any) -> dict[str, Any]:
    content = copy.deepcopy(GOOD)
    target: Any = content
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return content


def at(name: str, row: int, column: int, value: Any) -> dict[str, Any]:
    return changed(["frames", 0, name, row, column], value)


BAD: dict[str, tuple[Any, str]] = {
    "empty": ("", "empty"),
    "deep": ("[" * 100_000, "not JSON"),
    "list": ([], "frames"),
    "many": (changed(["frames"], [0] * 10_001), "too many"),
    "frame is a number": (changed(["frames"], [3]), "frame 0: must be an object"),
    "no K": (changed(["frames", 0, "K"], None), "K must be a list"),
    "bool": (at("K", 0, 2, True), "K must be a list"),
    "NaN": (at("K", 0, 2, math.nan), "finite"),
    "infinite in single precision": (at("K", 0, 0, 1e300), "must stay below"),
    "far": (at("world_to_camera", 0, 3, -1e39), "must stay below"),
    "zero in single precision": (at("K", 1, 1, 1e-300), "positive focal lengths"),
    "huge whole number": (at("K", 0, 2, 10**400), "finite|not JSON"),
    "zero focal": (at("K", 0, 0, 0), "focal"),
    "K's last row": (at("K", 2, 2, 2), "last row of K"),
    "skew": (at("K", 0, 1, 3), "skew"),
    "scaled": (at("world_to_camera", 0, 0, 1.01), "rotation"),
    "mirror": (at("world_to_camera", 0, 0, -1), "rotation"),
    "pose's last row": (at("world_to_camera", 3, 2, 0.5), "last row of world_to_camera"),
    "zero width": (changed(["width"], 0), "width"),
}


def path_content(**changes: Any) -> dict[str, Any]:
    keys = [{"time": 0, "eye": [0, 0, 0], "target": [0, 0, 3]}, {"time": 1.5, "eye": [0.2, 0, 0], "target": [0, 0, 3]}]
    return {"keyframes": keys} | changes


def with_key(**changes: Any) -> dict[str, Any]:
    """A file whose second key is changed; None takes a name away."""
    first, second = path_content()["keyframes"]
    return path_content(keyframes=[first, {n: v for n, v in (second | changes).items() if v is not None}])


def test_a_path_file_is_read(tmp_path: Path) -> None:
    content = with_key(up=[0, -1, 0.1], fov=50) | {"closed": True, "unit": "disparity"}
    path = load_path(write(tmp_path / "p.json", content))
    assert path.keys == (
        Keyframe(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
        Keyframe(1.5, (0.2, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.1), 50.0),
    )
    assert (path.closed, path.unit) == (True, "disparity")


BAD_PATHS: dict[str, tuple[Any, str]] = {
    "deep": ("[" * 100_000, "not JSON"),
    "no list": ({"keyframes": {}}, "needs a list"),
    "no key": (path_content(keyframes=[]), "two keyframes, got 0"),
    "too many": (path_content(keyframes=[0] * 10_001), "too many"),
    "unknown name": (path_content(loop=1), "unknown name 'loop'"),
    "closed 1": (path_content(closed=1), '"closed"'),
    "unit": (path_content(unit="feet"), '"unit"'),
    "no object": (path_content(keyframes=[1, 2]), "keyframe 0: must be an object"),
    "NaN": (with_key(eye=[math.nan, 0, 0]), 'keyframe 1: "eye" must be a finite number'),
    "a word": (with_key(eye=["left", 0, 0]), 'keyframe 1: "eye" must hold numbers, not "left"'),
    "two numbers": (with_key(target=[0, 0]), '"target" must be a list of three'),
    "no eye": (with_key(eye=None), 'keyframe 1: must be an object with "time", "eye"'),
    "key name": (with_key(roll=3), "keyframe 1: unknown name 'roll'"),
    "zero look": (with_key(target=[0.2, 0, 0]), "keyframe 1: eye and target coincide"),
    "up along": (with_key(up=[0.2, 0, -3]), "keyframe 1: up lies along the view"),
    "no up": (with_key(up=[0, 0, 0]), "keyframe 1: up has no length"),
    "wide": (with_key(fov=179), "keyframe 1: fov must be from 1 to 170"),
    "same time": (with_key(time=0), "times must increase, by a microsecond at least: keyframe 1 is at 0 s"),
    "twice": ('{"keyframes": [], "keyframes": []}', "'keyframes' is there twice"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_camera_file_is_refused_with_the_reason(tmp_path: Path, kind: str) -> None:
    content, says = BAD[kind]
    refused(load_cameras, write(tmp_path / "c.json", content), says)


@pytest.mark.parametrize("kind", BAD_PATHS)
def test_a_bad_path_file_is_refused_with_the_reason(tmp_path: Path, kind: str) -> None:
    content, says = BAD_PATHS[kind]
    refused(load_path, write(tmp_path / "p.json", content), re.escape(says))


@pytest.mark.parametrize(("load", "kind"), [(load_cameras, "camera file"), (load_path, "path file")])
def test_files_that_are_not_there_not_text_or_far_too_long(
    tmp_path: Path, load: Callable[[Path], object], kind: str
) -> None:
    refused(load, tmp_path / "none.json", f"no such {kind}")
    refused(load, tmp_path, f"name of a {kind}")
    (tmp_path / "c.json").write_bytes(b"\xff\xfe\x00{")
    refused(load, tmp_path / "c.json", "not JSON")
    with open(tmp_path / "c.json", "wb") as sparse:
        sparse.truncate(1 << 30)
    refused(load, tmp_path / "c.json", f"too long for a {kind}")
