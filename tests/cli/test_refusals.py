"""Bad input to `spackle predict` and `spackle render` prints one line and leaves no files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
import torch
from helpers import DATA
from helpers.command import FILES, SHORT, names_in, refuses, run
from helpers.photos import write_photo
from helpers.systems import needs_named_pipes

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render import get_renderer


@pytest.fixture(scope="module", autouse=True)
def kernels() -> None:
    """Compiled kernels; otherwise a command says that they are compiled, in a line of its own."""
    get_renderer("cpu").render(Gaussians.empty(), Camera(torch.eye(3), torch.eye(4), 16, 16))


INPUTS = {"predict": ("photo.png", "--depth", "depth.npy"), "render": ("scene.ply",)}
# Options of both commands, and a part of the error message.
BOTH = [
    ("--fps nan", "--fps nan"),
    ("--loop 0", "--loop 0"),
    ("--ipd 0.06", "--ipd 0.06 needs --stereo"),
    ("--stereo sbs --ipd 0", "--ipd must be"),
    ("--stereo anaglyph --show depth", "anaglyph"),
    ("--stereo sbs --ipd 5 --convergence 1", "smaller --ipd"),
    ("--stereo sbs --size 8000x8000", "8192"),
    ("--size 2:3", "--size 2:3: give width and height up to 8192, such as 1280x720, 16:9"),
    ("--overscan 0.6", "--overscan must be between 0 and 0.5"),
    ("--disparity 3", "--disparity"),
    (
        "--trajectory rotate_back",
        "--trajectory rotate_back is unknown: did you mean rotate? There are swipe, shake, rotate,",
    ),
    ("--path bad.json", "bad.json: keyframe 1: eye and target coincide"),
    ("--path good.json --disparity 0.2", "--disparity 0.2"),
    ("--path good.json --cameras views.json", "--cameras"),
    ("--cameras nowhere.json", "nowhere.json"),
    ("--cameras views.json --frames 9", "--frames 9"),
]
PREDICT = [
    *((f"--focal-px {value}", "--focal-px") for value in ("nan", "1e39", "50 --fov 60")),
    ("--focal-mm 0", "--focal-mm"),
    ("--fov 180", "--fov"),
    *((f"--frames {value}", "--frames") for value in ("0", "1000000", "many")),
    *((f"--seconds {value}", "--seconds") for value in ("0", "2 --frames 9")),
    *((f"--sharp-windows {value}", "--sharp-windows") for value in ("1", "many", "36")),
    *((f"--residual {file}.safetensors", f"{file}.safetensors") for file in ("nowhere", "bad")),
    *((f"{option} 0", option) for option in ("--workers", "--threads")),
    ("--depth-out depth.tiff", "depth.tiff"),
    ("--depth-out a/depth.npy", "--depth-out a/depth.npy"),
    ("--base sharp9", "--base"),
    ("--device cuda", "--device"),
    (
        "--device cuda:x",
        "--device cuda:x is unknown: did you mean cuda:N? There are auto, cpu, cuda,",
    ),
    ("-c weights.pt", "-c"),
    ("--cameras sizes.json", "--no-render"),
    *(
        (f"--no-render {option}", option.split()[0])
        for option in ("--fps 24.0", "--loop 2", "--format webm")
    ),
    ("--cameras extreme.json", "extreme.json"),
    ("--depth wrong.npy", "wrong.npy"),
    ("--depth disp0.npy", "disp0.npy"),  # without a calibration
]
RENDER = [
    ("--focal-px inf", "--focal-px"),
    ("--fov 60 --cameras views.json", "--fov"),
    ("-o film.avi", "film.avi: not a kind of video"),
    ("-o a.gif --format webm", "--format webm"),
    ("-o a.mp4 --cameras sizes.json", "sizes.json"),
]
ROWS = [
    (command, *row)
    for command, rows in (("predict", BOTH + PREDICT), ("render", BOTH + RENDER))
    for row in rows
]


@pytest.fixture
def place(
    tmp_path: Path, pair: tuple[Path, Path], scene: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A folder with a photo, its depth, a scene, and files that cannot be used."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(DATA / "refused", tmp_path, dirs_exist_ok=True)
    shutil.copy(scene, "scene.ply")
    shutil.copy(pair[1], "disp0.npy")
    return tmp_path


@pytest.mark.parametrize(("command", "options", "says"), ROWS, ids=lambda value: value[:40])
def test_options_that_cannot_be(place: Path, command: str, options: str, says: str) -> None:
    before = names_in(place)
    short = (
        ()
        if any(word in options for word in ("--cameras", "--path", "--frames", "--seconds"))
        else SHORT
    )
    result = run(command, *INPUTS[command], "-o", "new/out", *short, *options.split())
    assert (result.code, result.out) == (2, ""), result.err
    assert result.lines[-1].startswith("error: ")
    assert says in result.lines[-1]
    assert names_in(place) == before


def test_an_input_has_to_be_named(tmp_path: Path) -> None:
    refuses(run("predict"), "no photo: give photos, folders of photos, one clip, or --posed FOLDER")
    refuses(run("render", "-o", tmp_path / "out"), "SCENE")
    refuses(
        run("render", tmp_path / "missing.ply", "-o", tmp_path / "out"), tmp_path / "missing.ply"
    )
    address = "https://example.com/a.jpg"
    refuses(run("predict", address), f"{address}: an address, not a file: download it first")
    refuses(
        run("predict", write_photo(tmp_path / "a.png"), "--base", "rgbd", "-o", tmp_path / "out"),
        "--depth",
    )


@pytest.mark.parametrize(
    "kind",
    ["missing", "text", "an empty folder", pytest.param("a pipe", marks=needs_named_pipes)],
)
def test_files_that_are_no_photo_and_no_depth_map(
    tmp_path: Path, pair: tuple[Path, Path], kind: str
) -> None:
    bad = tmp_path / "bad.png"
    if kind == "a pipe":
        os.mkfifo(bad)
    elif kind == "an empty folder":
        bad.mkdir()
    elif kind == "text":
        bad.write_text("a photo")
    for photo, depth in ((bad, pair[1]), (pair[0], bad)):
        refuses(
            run("predict", photo, "--depth", depth, "-o", tmp_path / "new" / "out", *SHORT), bad
        )
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("kind", ["file", "file/deep", "scene.ply"])
def test_outputs_that_cannot_be_written(
    tmp_path: Path, pair: tuple[Path, Path], scene: Path, kind: str
) -> None:
    (tmp_path / "file").write_text("in the way")
    command = ("predict", pair[0], "--depth", pair[1], *SHORT, "-o")
    if kind in FILES:  # a folder in the place of a result
        (tmp_path / "out" / "photo" / kind).mkdir(parents=True)
        refuses(run(*command, tmp_path / "out"), kind)
        assert names_in(tmp_path / "out" / "photo") == {
            kind
        }  # known before the first file was written
        return
    before, out = names_in(tmp_path), tmp_path / kind
    refuses(run(*command, out), "output folder", "-o")
    refuses(run("render", scene, "-o", out, *SHORT), "output folder")
    assert (names_in(tmp_path), (tmp_path / "file").read_text()) == (before, "in the way")
