"""The command as a process: help, interruption, messages and JSON."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from helpers.command import FILES, SHORT, Run, names_in, refuses, report_of, run
from helpers.photos import CLIPS, metres, write_depth, write_photo
from helpers.systems import needs_full_device, needs_posix_signals
from PIL import Image

import spackle
from spackle import cli
from spackle.bases.settings import AUTO_NETWORKS, RGBD
from spackle.core.trajectories import TRAJECTORIES
from spackle.depth.units import DEPTH_KINDS
from spackle.inpaint.registry import INPAINTERS
from spackle.paper.evaluation.datasets import DATASETS
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.metrics import METRICS
from spackle.runtime.device import PRECISIONS
from spackle.weights import PUBLISHED_WEIGHTS

COMMAND = [sys.executable, "-m", "spackle"]
COMMANDS = ["predict", "render", "view", "export", "info", "demo"]
COMMANDS += ["train", "evaluate", "tables", "bench", "dataset", "weights"]


def test_the_installed_command_and_python_m_spackle_are_this_one(tmp_path: Path) -> None:
    commands = [point for point in entry_points(group="console_scripts") if point.name == "spackle"]
    assert [point.load() for point in commands] == [cli.run]
    missing = tmp_path / "missing.png"
    for options, code in (
        (["--version"], 0),
        (["predict", str(missing), "-o", str(tmp_path / "out")], 2),
    ):
        done = subprocess.run(
            [*COMMAND, *options], capture_output=True, text=True, check=False, timeout=300
        )
        assert (done.returncode, len((done.stdout + done.stderr).splitlines())) == (code, 1)
        assert (str(missing) if code else spackle.__version__) in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "shown"), [("--help", "predict"), ("predict --help", "--trajectory")]
)
def test_help_does_not_wait(words: str, shown: str) -> None:
    code = f"""
import sys
sys.argv = ['spackle', *{words.split()}]
from spackle.cli import main
try:
    main()
finally:
    assert not {{'torch', 'numba', 'av', 'fastapi'}} & set(sys.modules)
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (result.returncode, shown in result.stdout) == (0, True), result.stderr


def test_ctrl_c_is_one_line_and_leaves_an_old_set_whole(
    tmp_path: Path,
    pair: tuple[Path, Path],
    plain: tuple[Path, Run],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    old = shutil.copytree(plain[0], tmp_path / "old" / "photo")
    monkeypatch.setattr("spackle.results.photo_folder.write_json", interrupted)
    for out in (tmp_path / "new" / "out", tmp_path / "old"):
        result = run(
            "predict", pair[0], "--depth", pair[1], "-o", out, "-v", "--disparity", "0.5", *SHORT
        )
        assert result.code == 130
        assert [line.split(":")[0] for line in result.lines[:2]] == [
            "  load",
            "  prepare",
        ]  # -v times every stage
        assert result.lines[-1] == "interrupted"
    assert not (tmp_path / "new").exists()
    assert {name: (old / name).read_bytes() for name in names_in(old)} == {
        name: (plain[0] / name).read_bytes() for name in FILES
    }


@needs_posix_signals
def test_a_terminated_run_leaves_nothing(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    words = ["predict", pair[0], "--depth", pair[1], "-o", tmp_path / "out", "--frames", "1500"]
    with subprocess.Popen([*COMMAND, *map(str, words)], stderr=subprocess.DEVNULL) as process:
        try:
            deadline = time.monotonic() + 240
            while not list((tmp_path / "out" / "photo").glob(".new/.video.*.mp4")):
                assert process.poll() is None, "ended before it could be stopped"
                assert time.monotonic() < deadline
                time.sleep(0.005)
            process.terminate()
            assert process.wait(timeout=120) == 128 + 15
        finally:
            process.kill()
    assert not (tmp_path / "out").exists()


def test_no_control_character_of_a_name_reaches_the_terminal(tmp_path: Path) -> None:
    evil = tmp_path / "a\x1b]0;owned\x07\x9b2J\n\n\u202e\udcff.png"
    result = run("predict", evil, "--json", "-o", tmp_path / "out")
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert (result.out + result.err).replace("\n", "").isprintable()
    assert r"a\x1b]0;owned\x07\x9b2J  \u202e\udcff.png" in result.err


@needs_full_device
def test_a_full_standard_output_is_reported_in_one_line(scene: Path, tmp_path: Path) -> None:
    words = [*COMMAND, "export", str(scene), "-o", str(tmp_path / "a.splat"), "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert (
        done.stderr.splitlines()[-1]
        == "error: cannot write to the standard output: No space left on device"
    )


@pytest.mark.parametrize(
    ("failure", "says"),
    [
        (MemoryError(), "not enough memory: close other programs, or give something smaller"),
        (MemoryError("Unable to allocate 98 GiB"), "not enough memory (Unable to allocate 98 GiB)"),
        (RuntimeError("DefaultCPUAllocator: can't allocate"), "not enough memory: close"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "cannot write to the standard output: Brok"),
        (OSError(errno.EIO, "Input/output error"), "a file cannot be read or written: Input/outp"),
        (OSError(errno.EIO, "Bad disk", "a.ply", None, "b.ply"), "a.ply: cannot be read or writt"),
        (
            PermissionError(errno.EACCES, "Denied", b"x\xff.ply"),
            "x\ufffd.ply: cannot be read or wr",
        ),
    ],
)
def test_a_failure_of_memory_disk_or_pipe_is_one_line(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, says: str
) -> None:
    def fail(**options: object) -> None:
        raise failure

    monkeypatch.setattr("spackle.cli.app", fail)
    result = run("info", "a.ply")
    refuses(result, says)
    assert result.err.startswith(f"error: {says}")
    assert json.loads(run("info", "a.ply", "--json").out)["error"].startswith(says)


def test_a_fault_of_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    for fault in (ValueError("a fault"), RuntimeError("another"), KeyError("a")):
        monkeypatch.setattr("spackle.cli.app", mock.Mock(side_effect=fault))
        with pytest.raises(type(fault)):
            run("info", "a.ply")


def test_every_command_has_a_help() -> None:
    for command in COMMANDS:
        result = run(command, "--help")
        assert (result.code, f"spackle {command}" in result.out.splitlines()[0]) == (0, True)
    assert "--sharp-windows" in run("predict", "--help-all").out


def test_help_names_everything_that_is_registered() -> None:
    bases = [*AUTO_NETWORKS, RGBD, "hf:", "package.module:Class"]
    predict, build = run("predict", "--help-all").out, run("dataset", "build", "--help").out
    evaluate, bench = run("evaluate", "--help").out, run("bench", "--help").out
    for text in (predict, build, evaluate, bench):
        assert [name for name in bases if name not in text] == []
    for name in (*TRAJECTORIES, *PRECISIONS, *DEPTH_KINDS):
        assert name in predict
    for text in (build, evaluate):
        assert [name for name in INPAINTERS if name not in text] == []
    assert [name for name in (*METHODS, *METRICS) if name not in evaluate] == []
    for text in (evaluate, bench):
        assert [name for name in (*DATASETS, "package.module:NAME") if name not in text] == []
    weights = run("weights", "get", "--help").out
    assert [name for name in PUBLISHED_WEIGHTS if name not in weights] == []


def test_help_lists_the_papers_experiments_apart() -> None:
    people, experiments = run("--help").out.split("The paper's experiments:")
    for name in ("predict", "view", "serve", "render", "export", "info", "demo", "weights"):
        assert f"\n  {name} " in people
    for name in ("train", "evaluate", "tables", "figures", "bench", "dataset"):
        assert f"\n  {name} " in experiments
        assert f"\n  {name} " not in people


def test_info_says_what_a_file_is(tmp_path: Path, scene: Path, pair: tuple[Path, Path]) -> None:
    spz, clip, depth = tmp_path / "a.spz", CLIPS / "small.mp4", tmp_path / "mm.png"
    assert run("export", scene, "-o", spz).code == 0
    Image.fromarray((1000 * metres()).astype(np.uint16)).save(depth)
    expected = {
        scene: (
            "scene (.ply)",
            "base",
            "64×48, focal length 55.5 px, 60.0° wide",
            "--disparity 0.07",
            "spackle view",
        ),
        spz: ("scene (.spz)", "number of base Gaussians unknown", "not stored", "spackle view"),
        pair[0]: (
            "photo",
            "64×48",
            "(default 30 mm)",
            "none inside",
            f"spackle predict {pair[0]} -o out",
        ),
        pair[1]: (
            "depth map",
            "64×48",
            "near 2 m, median 6 m, far 6 m",
            "0.0%",
            f"--depth {pair[1]}",
        ),
        depth: ("depth map", "depth, read as millimetres", "near 2 m"),
        clip: ("clip", "24×16", "3, 10 a second", "none", "spackle predict"),
    }
    for path, parts in expected.items():
        result = run("info", path)
        assert (result.code, result.err) == (0, "")
        assert all(part in result.out for part in parts), result.out
    facts = [json.loads(line) for line in run("info", *expected, "--json").out.splitlines()]
    assert [fact["file"] for fact in facts] == list(map(str, expected))
    (tmp_path / "a.txt").write_text("hello")
    refuses(run("info", tmp_path / "a.txt"), "a.txt", "not an image")


def test_each_result_and_each_error_is_a_line_of_json(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write_photo(photos / "photo.png", 48, 36)
    write_depth(photos / "photo.npy", metres(32, 24))
    (photos / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    options = (
        "--depth",
        photos,
        "-o",
        tmp_path / "out",
        "--frames",
        2,
        "--residual",
        "initial",
        "--json",
    )
    first, again = (run("predict", photos, *options) for _ in range(2))
    assert first.code == again.code == 1
    report, bad = (json.loads(line) for line in first.out.splitlines())
    assert report == {
        "folder": str(tmp_path / "out" / "photo"),
        **report_of(tmp_path / "out" / "photo"),
    }
    assert "torn.png" in bad["error"]
    assert json.loads(again.out.splitlines()[0])["done_already"] is True
    result = run("predict", photos / "torn.png", "-o", tmp_path / "out", "--json")
    assert (result.code, len(result.lines)) == (2, 1)
    assert "torn.png" in json.loads(result.out)["error"]
    scene = tmp_path / "out" / "photo" / "scene.ply"
    rendered = run("render", scene, "-o", tmp_path / "film.mp4", "--frames", 2, "--json")
    assert json.loads(rendered.out)["file"] == str(tmp_path / "film.mp4")
    exported = run(
        "export",
        scene,
        "-o",
        tmp_path / "new" / "folder" / "a.splat",
        "-o",
        tmp_path / "a.spz",
        "--json",
    )
    files = [json.loads(line) for line in exported.out.splitlines()]
    assert [Path(line["file"]).stat().st_size for line in files] == [
        line["bytes"] for line in files
    ]
    assert [line["gaussians"] for line in files] == [report["merged"]] * 2
    listed = run("weights", "list", "--json").out.splitlines()
    assert [json.loads(line)["name"] for line in listed] == list(PUBLISHED_WEIGHTS)
