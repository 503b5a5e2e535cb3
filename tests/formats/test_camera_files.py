"""Camera and path files: what is read, and which files are refused."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from spackle.core.keyframes import Keyframe
from spackle.formats import load_cameras, load_path
from spackle.runtime.errors import InputError

FRAME = {
    "K": [[500, 0, 320.0], [0, 510.5, 240], [0, 0, 1]],
    "world_to_camera": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]],
}
CAMERAS: dict[str, Any] = {"width": 640, "height": 480, "frames": [FRAME]}
FIRST = {"time": 0, "eye": [0, 0, 0], "target": [0, 0, 3]}
SECOND = {"time": 1.5, "eye": [0.2, 0, 0], "target": [0, 0, 3]}
PATH: dict[str, Any] = {"keyframes": [FIRST, SECOND]}


def changed(content: dict[str, Any], *keys: Any, to: Any) -> dict[str, Any]:
    """A copy of the content with another value at a place."""
    content = target = copy.deepcopy(content)
    for key in keys[:-1]:
        target = target[key]
    target[keys[-1]] = to
    return content


def at(name: str, row: int, column: int, value: Any) -> dict[str, Any]:
    return changed(CAMERAS, "frames", 0, name, row, column, to=value)


def key(name: str, value: Any) -> dict[str, Any]:
    return changed(PATH, "keyframes", 1, name, to=value)


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_reads_the_documented_format(tmp_path: Path) -> None:
    small = FRAME | {"width": 100, "height": 50}
    first, second = load_cameras(write(tmp_path / "c.json", CAMERAS | {"frames": [FRAME, small]}))
    assert (first.width, first.height, second.width, second.height) == (640, 480, 100, 50)
    assert first.K.dtype == first.world_to_camera.dtype == torch.float32
    assert first.K.tolist() == FRAME["K"]
    assert torch.equal(first.world_to_camera, torch.tensor(FRAME["world_to_camera"]))
    assert load_cameras(write(tmp_path / "c.json", {"frames": [small]}))[0].width == 100
    assert (
        len(load_cameras(write(tmp_path / "c.json", at("world_to_camera", 0, 0, 1.0003)))) == 1
    )  # nearly rigid


def test_a_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    for content, load in ((CAMERAS, load_cameras), (PATH, load_path)):
        assert load(write(tmp_path / "c.json", "\ufeff" + json.dumps(content)))


def test_a_path_file_is_read(tmp_path: Path) -> None:
    keys = [FIRST, SECOND | {"up": [0, -1, 0.1], "fov": 50}]
    path = load_path(
        write(tmp_path / "p.json", {"keyframes": keys, "closed": True, "unit": "disparity"})
    )
    assert path.keys == (
        Keyframe(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
        Keyframe(1.5, (0.2, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.1), 50.0),
    )
    assert (path.closed, path.unit) == (True, "disparity")


BAD: list[tuple[Any, str]] = [
    ("", "empty"),
    ("{" * 1000, "invalid JSON"),
    ({"frames": []}, "frames: "),
    (changed(CAMERAS, "frames", to=[FRAME] * 10_001), "at most 10000"),
    (changed(CAMERAS, "frames", 0, "K", to=None), "frames.0.K: "),
    (at("K", 0, 2, True), "frames.0.K.0.2: "),
    (at("K", 0, 2, math.nan), "finite number"),
    (at("K", 0, 0, 1e300), "at most 1e"),  # infinite in single precision
    (at("K", 1, 1, 1e-300), "positive focal lengths"),  # zero in single precision
    (at("K", 0, 2, 10**400), "frames.0.K.0.2: "),
    (at("K", 2, 2, 2), "K must be"),
    (at("K", 0, 1, 3), "skew"),
    (at("world_to_camera", 0, 0, 1.01), "rotation"),
    (at("world_to_camera", 0, 0, -1), "rotation"),
    (at("world_to_camera", 3, 2, 0.5), "rotation"),
    (changed(CAMERAS, "width", to=0), "width: "),
    ({"frames": [FRAME]}, "frame 0: width and height"),
]
BAD_PATHS: list[tuple[Any, str]] = [
    (changed(PATH, "keyframes", to=[FIRST]), "two keyframes, got 1"),
    (PATH | {"loop": 1}, "loop: "),
    (PATH | {"closed": 1}, "closed: "),
    (PATH | {"unit": "feet"}, "unit: "),
    (key("eye", ["left", 0, 0]), "keyframes.1.eye.0: "),
    (key("eye", [1e7, 0, 0]), "keyframes.1.eye.0: "),
    (key("roll", 3), "keyframes.1.roll: "),
    (key("target", [0.2, 0, 0]), "keyframe 1: eye and target coincide"),
    (key("up", [0.2, 0, -3]), "keyframe 1: up is parallel to the viewing direction"),
    (key("fov", 179), "keyframe 1: fov must be from 1 to 170"),
    (key("time", 0), "times must increase, by a microsecond at least: keyframe 1 is at 0 s"),
]


@pytest.mark.parametrize(("content", "says"), BAD + BAD_PATHS, ids=lambda value: str(value)[:40])
def test_a_bad_file_is_refused_with_the_reason(tmp_path: Path, content: Any, says: str) -> None:
    path = write(tmp_path / "c.json", content)
    with pytest.raises(InputError) as caught:
        (load_path if "keyframes" in content else load_cameras)(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert (says in str(caught.value), str(caught.value).count(", not ") < 2) == (True, True)


def test_a_file_that_is_missing_or_too_large_is_refused(tmp_path: Path) -> None:
    for load, kind in ((load_cameras, "camera file"), (load_path, "path file")):
        with pytest.raises(InputError, match=f"no such {kind}"):
            load(tmp_path / "none.json")
    with open(tmp_path / "c.json", "wb") as sparse:
        sparse.truncate(1 << 30)
    with pytest.raises(InputError, match="too long for a path file"):
        load_path(tmp_path / "c.json")
