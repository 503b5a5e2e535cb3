"""`spackle fill --remove`: a mask drawn on a photo takes a thing out of its scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.command import names_in, refuses, run
from helpers.scenes import Scene as PhotoScene
from helpers.scenes import psnr, same_bits
from helpers.things_in_rooms import Room, room, sphere
from PIL import Image

from spackle.core.camera import Camera
from spackle.core.filters import maximum_filter
from spackle.formats.ply import save_ply
from spackle.formats.scene_files import load_scene
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio, hole_mask

CPU = CpuRenderer()
PHOTO = Camera.from_focal(112.0, 120, 90)


def made_room() -> Room:
    return room(
        sphere((0.1, 0.0, 3.0), 0.5, 0.03),
        floor_height=None, width=120, height=90, focal=112.0, spacing=0.04,
    )  # fmt: skip


@pytest.fixture(scope="module")
def made() -> Room:
    return made_room()


@pytest.fixture
def place(made: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a photo's scene, masks, and a file of cameras."""
    monkeypatch.chdir(tmp_path)
    view = CPU.render(made.scene, made.camera)
    base = PhotoScene(view.rgb, view.depth, PHOTO).base()
    save_ply(base, "scene.ply", camera=PHOTO, base_count=len(base), disparity=0.1)
    save_ply(base, "bare.ply")
    white = np.asarray(maximum_filter(made.mask(), 3))
    grey = Image.fromarray(white.astype(np.uint8) * 255)
    grey.save("mask.png")
    grey.resize((240, 180)).save("large.png")
    grey.convert("1").save("bits.png")
    Image.fromarray(white.astype(np.uint16) * 65_535).save("deep.png")
    paint = np.zeros((90, 120, 4), np.uint8)
    paint[white] = (255, 60, 60, 255)
    paint[~white] = (255, 255, 255, 0)  # white, but transparent
    Image.fromarray(paint).save("paint.png")
    grey.resize((90, 90)).save("square.png")
    Image.new("L", (120, 90)).save("black.png")
    Image.new("L", (120, 90), 255).save("white.png")
    entry = {"K": PHOTO.K.tolist(), "width": 120, "height": 90}
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).tolist()
    frames = [
        {**entry, "world_to_camera": torch.eye(4).tolist()},
        {**entry, "world_to_camera": away},
    ]
    Path("cameras.json").write_text(json.dumps({"frames": frames}))
    return tmp_path


def test_a_mask_takes_a_thing_out_and_what_it_hid_is_filled(place: Path, made: Room) -> None:
    result = run("fill", "scene.ply", "--remove", "mask.png", "-o", "new/out.ply", "--json")
    assert result.code == 0, result.err
    report = json.loads(result.out)
    assert names_in(place / "new") == {"out.ply", "out_removed.ply"}
    before = load_scene(Path("scene.ply"))
    edit = load_scene(Path("new/out_removed.ply"))
    patched = load_scene(Path("new/out.ply"))

    # The rows that are left are the file's, byte for byte, and the patch comes after them.
    def rows(name: str) -> bytes:
        return Path(name).read_bytes().split(b"end_header\n", 1)[1]

    assert rows("new/out.ply").startswith(rows("new/out_removed.ply"))
    own = np.frombuffer(rows("scene.ply"), np.uint8).reshape(len(before.gaussians), -1)
    left = np.frombuffer(rows("new/out_removed.ply"), np.uint8).reshape(len(edit.gaussians), -1)
    own_rows = {row.tobytes() for row in own}
    assert all(row.tobytes() in own_rows for row in left)
    assert edit.base_count == len(edit.gaussians) == len(before.gaussians) - report["removed"]
    assert same_bits(patched.gaussians.select(slice(0, len(edit.gaussians))), edit.gaussians)
    assert len(patched.gaussians) == len(edit.gaussians) + report["added"]
    assert patched.camera is not None
    assert patched.disparity == before.disparity

    # The photo's view: whole again, and the same outside of the mask.
    mask = maximum_filter(made.mask(), 3)
    shown, cut, whole = (CPU.render(scene.gaussians, PHOTO) for scene in (before, edit, patched))
    assert float(hole_mask(cut.alpha)[made.mask()].float().mean()) > 0.98
    assert hole_area_ratio(whole.alpha) < 0.01 * hole_area_ratio(cut.alpha)
    assert psnr(shown.rgb[~mask], whole.rgb[~mask]) > 45
    assert report["before"] > 50 * report["after"]


@pytest.mark.parametrize("mask", ["large.png", "bits.png", "deep.png", "paint.png"])
def test_masks_of_other_kinds_and_sizes_mark_the_same(place: Path, mask: str) -> None:
    counts = []
    for name in ("mask.png", mask):
        result = run(
            "fill", "scene.ply", "--remove", name, "-o", "out.spz", "--json",
            "--cameras", "cameras.json", "--camera", "0",
        )  # fmt: skip
        assert result.code == 0, result.err
        counts.append(json.loads(result.out)["removed"])
    assert abs(counts[1] / counts[0] - 1) < 0.02
    assert names_in(place) >= {"out.spz", "out_removed.spz"}


def test_a_box_takes_out_what_is_in_it(place: Path) -> None:
    box = "-1,-1,2,1,1,4"
    result = run("fill", "scene.ply", "--box", box, "-o", "out.ply", "--json")
    assert result.code == 0, result.err
    means = load_scene(Path("scene.ply")).gaussians.means
    low, high = torch.tensor([-1.0, -1.0, 2.0]), torch.tensor([1.0, 1.0, 4.0])
    inside = ((means >= low) & (means <= high)).all(-1)
    assert json.loads(result.out)["removed"] == int(inside.sum()) > 100


REFUSED = [
    ("--remove black.png", "black.png: the mask marks nothing"),
    ("--remove white.png", "white.png: the mask marks everything"),
    ("--remove square.png", "square.png: the mask has 90×90 pixels, and the camera of scene.ply"),
    ("--remove nowhere.png", "nowhere.png"),
    ("--remove scene.ply", "scene.ply"),
    ("--remove mask.png --camera 0", "--camera 0: give the file"),
    ("--remove mask.png --camera 7 --cameras cameras.json", "has no camera 7"),
    ("--remove mask.png --camera 1 --cameras cameras.json", "the mask marks no Gaussian"),
    ("--remove mask.png --remove mask.png", "give each mask its --camera"),
    ("--remove mask.png --camera 0 --camera 1 --cameras cameras.json", "2 times"),
    ("--camera 0 --cameras cameras.json", "--camera 0 needs --remove"),
    ("--remove mask.png --background fill", "--background fill"),
    ("--box 1,2,3", "--box 1,2,3: give two opposite corners"),
    ("--box 0,0,0,1,1,nan", "--box"),
    ("--box 0,0,0,0,1,1", "holds nothing"),
    ("--box 50,50,50,60,60,60", "--box marks no Gaussian"),
    ("--box=-99,-99,-99,99,99,99", "marks the whole scene"),
]


@pytest.mark.parametrize(("options", "says"), REFUSED, ids=lambda value: value[:50])
def test_removals_that_cannot_be_are_refused(place: Path, options: str, says: str) -> None:
    CPU.render(load_scene(Path("scene.ply")).gaussians, PHOTO)  # compiles what the command needs
    before = names_in(place)
    result = run("fill", "scene.ply", "-o", "new/out.ply", *options.split())
    assert (result.code, result.out) == (2, ""), result.err
    assert result.lines[-1].startswith("error: ")
    assert says in result.lines[-1]
    assert names_in(place) == before


def test_a_scene_without_a_camera_asks_for_one(place: Path) -> None:
    refuses(
        run("fill", "bare.ply", "--remove", "mask.png", "-o", "new/out.ply"),
        "bare.ply: has no camera of its own", "--cameras", "--camera",
    )  # fmt: skip
    refuses(run("fill", "scene.ply", "--remove", "mask.png", "-o", "scene.ply"), "the scene itself")
