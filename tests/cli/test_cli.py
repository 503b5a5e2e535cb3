"""The command in a process of its own, what it says, and what a terminal sees."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from command import FILES, SHORT, decode, names_in, predicted, run
from photos import (
    metres,
    read_ply,
    write_depth,
    write_pair,
    write_photo,
)
from rich.console import Console

import spackle
from spackle import cli
from spackle.cli import app
from spackle.progress import Reporter

SCRIPT = Path(sys.executable).with_name("spackle")

COMMAND = [str(SCRIPT)] if SCRIPT.exists() else [sys.executable, "-c", "from spackle.cli import main; main()"]


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return write_pair(tmp_path)


def test_verbose_times_every_stage(tmp_path: Path) -> None:
    result = predicted(*write_pair(tmp_path), tmp_path, "-v")
    timed = [line.split(":")[0].strip() for line in result.lines if line.startswith("  ")]
    assert timed == ["load", "prepare", "base", "complete", "write", "video", "measure"]


def test_a_terminal_gets_bars_and_a_file_does_not() -> None:
    for terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
        with Reporter(console=console).stage("complete", {}) as step:
            step(3, 7)
        text = console.file.getvalue()  # type: ignore[attr-defined]
        assert ("complete" in text, "3/7" in text) == (terminal, terminal)


def test_usage_errors(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    for options in (("--trajectory", "spiral"), ("--mode", "x"), ("--frames", "many"), ("--nonsense",)):
        result = run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "out", *options)
        assert result.code == 2
        assert options[0] in result.err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [("predict", "-o", "out"), ("dataset", "build", "--photos", "x", "-o", "out")])
def test_a_path_of_another_name_is_told_those_there_are(command: tuple[str, ...]) -> None:
    result = run(*command, "--trajectory", "rotate_back")
    assert "--trajectory': 'rotate_back' is not one of 'swipe', 'shake', 'rotate', 'rotate-forward'" in result.err
    shown = " ".join(run(*command, "--help").out.split())
    assert "--trajectory [swipe|shake|rotate|rotate-forward]" in shown


def test_python_m_spackle_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "spackle", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"spackle {spackle.__version__}\n"


def test_the_installed_command_is_this_one() -> None:
    commands = [point for point in entry_points(group="console_scripts") if point.name == "spackle"]
    assert [point.load() for point in commands] == [cli.main]


def test_help_does_not_wait_for_torch() -> None:
    code = "import sys; sys.argv = ['spackle', '--help']\nfrom spackle.cli import main\ntry: main()\n"
    code += "finally: assert not {'torch', 'numba', 'av'} & set(sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 0, result.stderr
    assert all(command in result.stdout for command in ("predict", "render", "demo"))


def test_a_process_succeeds_and_fails(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    for depth, code in ((pair[1], 0), (tmp_path / "missing.npy", 2)):
        arguments = ["predict", "-i", pair[0], "--depth", depth, "-o", tmp_path / f"out{code}", *SHORT]
        result = subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=300)
        assert result.returncode == code
        assert len(result.stderr.splitlines()) == (1 if code else 2)
        assert "Traceback" not in result.stderr
    assert names_in(tmp_path / "out0" / "photo") == FILES
    assert "missing.npy" in result.stderr
    assert not (tmp_path / "out2").exists()


def test_ctrl_c_is_one_line(tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("spackle.app.complete.complete", interrupted)
    result = run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "new" / "out", *SHORT)
    assert result.code == 130
    assert result.lines[-1] == "interrupted"
    assert not (tmp_path / "new").exists()


@contextlib.contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is dead when the block ends."""
    process = subprocess.Popen([*COMMAND, *map(str, arguments)], stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
def test_a_killed_run_leaves_whole_files_and_the_next_one_finishes(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    folder = tmp_path / "out" / "photo"
    arguments = ("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "out")
    with started(*arguments, "--frames", 1500) as process:
        deadline = time.monotonic() + 240
        while not list(folder.glob(".video.*.mp4")):
            assert process.poll() is None, "ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert names_in(folder) > {"base.ply", "scene.ply"}
    assert not {"video.mp4", "report.json"} & names_in(folder)  # not finished, so not there
    base, merged = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert merged.body[: len(base.body)] == base.body
    (folder / ".other.0123456789ab.ply").touch()  # somebody else's
    assert run(*arguments, *SHORT).code == 0
    assert names_in(folder) == {*FILES, ".other.0123456789ab.ply"}
    assert len(decode(folder / "video.mp4")) == 3


# The help on one screen, completion, lines of JSON

COMMANDS = ["predict", "render", "view", "export", "demo", "train", "evaluate", "tables", "bench", "dataset", "weights"]


def test_the_help_fits_a_screen_of_24_lines_and_begins_with_three_examples() -> None:
    lines = run("--help").out.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if line.rstrip().endswith("...")], "a command's line is cut off"
    assert [line.split()[:2] for line in lines if line.startswith("  spackle ")] == [
        ["spackle", "predict"],
        ["spackle", "view"],
        ["spackle", "export"],
    ]
    start = lines.index("Commands:") + 1
    assert [line.split()[0] for line in lines[start : start + len(COMMANDS)]] == COMMANDS
    assert run().err.splitlines() == lines  # nothing asked for: the same, but as an error


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_a_help_of_its_own(command: str) -> None:
    result = run(command, "--help")
    assert result.code == 0
    assert f"spackle {command}" in result.out.splitlines()[0]
    named = {"predict": "--input", "export": "--output", "view": "SCENE_OR_PHOTO"}  # in the examples of the first help
    assert named.get(command, "") in result.out


def test_shells_are_told_how_to_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    monkeypatch.setenv("_SPACKLE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "spackle ex")
    monkeypatch.setenv("COMP_CWORD", "1")
    found = CliRunner().invoke(app, [], prog_name="spackle").output
    assert found.split() == ["export"]


def small_pair(folder: Path) -> tuple[Path, Path]:
    return write_photo(folder / "photo.png", 32, 24), write_depth(folder / "photo.npy", metres(32, 24))


def test_each_result_is_a_line_of_json_and_nothing_else_is_on_the_standard_output(tmp_path: Path) -> None:
    picture, depth = small_pair(tmp_path)
    predicted = run(
        *("predict", "-i", picture, "--depth", depth, "-o", tmp_path / "out"),
        *("--frames", 2, "--residual", "seeds", "--json"),
    )
    assert predicted.code == 0
    report = json.loads(predicted.out)
    assert report["folder"] == str(tmp_path / "out" / "photo")
    written = json.loads((tmp_path / "out" / "photo" / "report.json").read_text())
    assert report == {"folder": report["folder"], **written}
    scene = tmp_path / "out" / "photo" / "scene.ply"
    rendered = run("render", "-i", scene, "-o", tmp_path / "film.mp4", "--frames", 2, "--json")
    assert json.loads(rendered.out)["file"] == str(tmp_path / "film.mp4")
    exported = run("export", scene, "-o", tmp_path / "a.splat", "-o", tmp_path / "a.spz", "--json")
    files = [json.loads(line) for line in exported.out.splitlines()]
    assert [Path(line["file"]).stat().st_size for line in files] == [line["bytes"] for line in files]
    assert [line["gaussians"] for line in files] == [report["merged"]] * 2
    assert json.loads(run("weights", "list", "--json").out)["name"] == "sharp"


def test_an_error_is_a_line_of_json_too(tmp_path: Path) -> None:
    result = run("predict", "-i", tmp_path / "nowhere.jpg", "-o", tmp_path / "out", "--json")
    assert result.code == 2
    assert "nowhere.jpg" in json.loads(result.out)["error"]
    assert len(result.lines) == 1  # and one for people


def test_in_a_folder_each_photo_has_its_line_failed_ones_too(tmp_path: Path) -> None:
    small_pair(tmp_path / "photos")
    (tmp_path / "photos" / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    options = ("--depth", tmp_path / "photos", "-o", tmp_path / "out", "--no-render", "--residual", "seeds", "--json")
    first, again = (run("predict", "-i", tmp_path / "photos", *options) for _ in range(2))
    assert first.code == again.code == 1
    good, bad = (json.loads(line) for line in first.out.splitlines())
    assert good["merged"] > 0
    assert "torn.png" in bad["error"]
    assert json.loads(again.out.splitlines()[0])["done_already"] is True
