"""What a terminal sees, and what a script does: the help on one screen, completion, lines of JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import run
from photos import metres, write_depth, write_photo

import spackle
from spackle.cli import app

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


def test_the_examples_name_options_that_there_are() -> None:
    for command, option in (("predict", "--input"), ("export", "--output")):
        assert option in run(command, "--help").out
    assert "SCENE_OR_PHOTO" in run("view", "--help").out


def test_the_version_is_the_packages() -> None:
    assert run("--version").out == f"spackle {spackle.__version__}\n"


def test_shells_are_told_how_to_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    monkeypatch.setenv("_SPACKLE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "spackle ex")
    monkeypatch.setenv("COMP_CWORD", "1")
    found = CliRunner().invoke(app, [], prog_name="spackle").output
    assert found.split() == ["export"]


def photo(folder: Path) -> tuple[Path, Path]:
    return write_photo(folder / "photo.png", 32, 24), write_depth(folder / "photo.npy", metres(32, 24))


def test_each_result_is_a_line_of_json_and_nothing_else_is_on_the_standard_output(tmp_path: Path) -> None:
    picture, depth = photo(tmp_path)
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


def test_without_json_the_standard_output_stays_empty(tmp_path: Path) -> None:
    picture, depth = photo(tmp_path)
    result = run(
        "predict", "-i", picture, "--depth", depth, "-o", tmp_path / "out", "--no-render", "--residual", "none"
    )
    assert (result.code, result.out) == (0, "")


def test_an_error_is_a_line_of_json_too(tmp_path: Path) -> None:
    result = run("predict", "-i", tmp_path / "nowhere.jpg", "-o", tmp_path / "out", "--json")
    assert result.code == 2
    assert "nowhere.jpg" in json.loads(result.out)["error"]
    assert len(result.lines) == 1  # and one for people


def test_in_a_folder_each_photo_has_its_line_failed_ones_too(tmp_path: Path) -> None:
    photo(tmp_path / "photos")
    (tmp_path / "photos" / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    options = ("--depth", tmp_path / "photos", "-o", tmp_path / "out", "--no-render", "--residual", "seeds", "--json")
    first, again = (run("predict", "-i", tmp_path / "photos", *options) for _ in range(2))
    assert first.code == again.code == 1
    good, bad = (json.loads(line) for line in first.out.splitlines())
    assert good["merged"] > 0
    assert "torn.png" in bad["error"]
    assert json.loads(again.out.splitlines()[0])["done_already"] is True
