"""Each script of benchmarks/ and research/ ends in one line if its input cannot be used."""

from __future__ import annotations

import argparse
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
FILES = [*ROOT.glob("benchmarks/*.py"), *ROOT.glob("research/**/*.py")]
# The files that can be started, by their paths below the repository.
SCRIPTS = {
    str(file.relative_to(ROOT)): file
    for file in sorted(FILES)
    if "tests" not in file.parts and 'if __name__ == "__main__":' in file.read_text()
}

# Command lines of each script, in the folder of `place`. The last word of each is what is wrong.
# Where no input is read, this is an output that cannot be written, or an option's value.
COMMANDS = {
    "benchmarks/clip.py": ("--side 0", "--frames 0"),
    "benchmarks/fill_background.py": ("unknown",),
    "benchmarks/filled_files.py": ("missing", "empty", "damaged", "photo.png -o missing/rows.json"),
    "benchmarks/gpu.py": ("-c missing", "-o missing/gpu.md"),
    "benchmarks/many_photos.py": ("-o damaged/out", "--photos 0"),
    "benchmarks/paper_times.py": (
        "missing",
        "empty",
        "damaged",
        "missing -o damaged/out",
        "missing --residual missing2",
        "missing --device unknown",
    ),
    "benchmarks/posed_photos.py": (
        "missing",
        "empty",
        "damaged",
        "empty --features missing",
        "empty --choices unknown",
        "empty -o missing/sheet.jpg",
        "empty -o sheet.xyz",
        "empty --json missing/numbers.json",
    ),
    "benchmarks/posed_scenes.py": ("still_life damaged/out",),
    "benchmarks/random_weights.py": (
        "--size micro missing/sharp.pt",
        "--size micro missing/sharp.safetensors",
    ),
    "benchmarks/removal.py": (
        "--features missing",
        "--features damaged",
        "--only unknown",
        "--figure-scene unknown",
        "-o missing/removal.md",
        "--figure missing/removal.jpg",
        "--figure removal.md",
    ),
    "benchmarks/rendered_scenes.py": ("-o damaged/out",),
    "benchmarks/reproduce.py": ("-o damaged/out", "--features missing", "--features damaged"),
    "benchmarks/reproduced_claims.py": ("missing", "empty", "damaged"),
    "benchmarks/same_results.py": (
        "--against missing",
        "--against damaged",
        "-o missing/hashes.json",
    ),
    "benchmarks/scoreboard.py": (
        "missing",
        "empty",
        "damaged",
        "pairs",
        "pairs --scenes unknown",
        "pairs --features missing",
        "pairs --against missing",
        "pairs --against damaged",
        "pairs -o missing/now.json",
        "--photos missing",
        "--photos empty",
        "--photos photos -o missing/sheet.jpg",
        "--photos photos -o sheet.json",
    ),
    "benchmarks/serve.py": ("-o missing/results.json", "--photos 0"),
    "benchmarks/sharp.py": (
        "--weights missing",
        "--weights damaged --photo missing",
        "--weights damaged --photo photo.png --original missing",
    ),
    "benchmarks/soak.py": ("-o missing/results.json",),
    "benchmarks/strangers.py": (
        "draw -o list.txt missing",
        "ends -o ends missing",
        "sheets -o sheets --key key.json missing",
    ),
    "benchmarks/suite.py": ("-o damaged/out", "--only unknown", "-c missing", "--residual missing"),
    "research/lite/benchmark.py": (
        "--stereo missing",
        "--stereo empty",
        "--stereo damaged",
        "--unit 1 --rgbd missing",
        "--unit 1 --rgbd empty",
        "--rgbd empty",
        "--rooms missing",
        "--rooms empty",
        "--standing missing",
        "--standing empty",
        "--weights missing",
        "--weights damaged",
        "--pictures missing/sheet.png",
    ),
    "research/lite/rebuild.py": ("-o damaged/out", "-o out data.photos=missing"),
    "research/lite/train.py": ("-o out --recipe missing", "-o out --recipe damaged"),
    "research/rebuild_open.py": (
        "--features photo.png --photos photos --office photos -o damaged/out",
        "-o out --features photo.png --office photos --photos missing",
        "-o out --features photo.png --photos photos --office missing",
        "-o out --photos photos --office photos --features missing",
    ),
    "research/worlds/fetch.py": ("--cache damaged/cache",),
    "research/worlds/judge_residual.py": (
        "--features missing2 missing",
        "--features missing2 damaged",
        "initial --pairs pairs --features missing",
        "initial --features missing2 --pairs missing",
        "initial --features missing2 --pairs empty",
        "initial --features missing2 --worlds missing",
        "initial --features missing2 --worlds empty",
        "initial --features missing2 --pairs pairs --sheet missing/sheet.png",
    ),
    "research/worlds/make.py": (
        "-o out --photos missing",
        "-o out --photos empty",
        "-o out --part 3/2",
        "-o out --part x",
    ),
    "research/worlds/model_sheet.py": ("-o damaged/out",),
    "research/worlds/torcs.py": ("--cache damaged/cache",),
    "research/worlds/train_residual.py": ("-o out --recipe missing",),
    "research/worlds/world_sheet.py": (
        "-o sheet.png missing",
        "-o sheet.png empty",
        "-o sheet.png damaged",
        "-o sheet.png worlds",
        "empty -o missing/sheet.png",
        "empty -o sheet",
    ),
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: with a photo, a folder of photos, and input that cannot be used."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged").write_bytes(b"\x00\xffneither a picture nor weights")
    (tmp_path / "pairs" / "first").mkdir(parents=True)
    (tmp_path / "pairs" / "first" / "scene.json").write_text("{}")
    (tmp_path / "worlds").mkdir()
    (tmp_path / "worlds" / "worlds-00000.tar").write_bytes(b"no archive")
    (tmp_path / "photos").mkdir()
    picture = Image.fromarray(np.zeros((48, 64, 3), np.uint8))
    picture.save(tmp_path / "photo.png")
    picture.save(tmp_path / "photos" / "photo.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def exit_code(script: str, words: str, monkeypatch: pytest.MonkeyPatch) -> object:
    """Run a script in this process as `python SCRIPT WORDS` does; how it ends.

    The test is skipped if a package is missing that only this script needs.
    """
    monkeypatch.setattr(sys, "argv", [str(SCRIPTS[script]), *words.split()])
    try:
        runpy.run_path(str(SCRIPTS[script]), run_name="__main__")
    except SystemExit as end:
        return end.code
    except KeyboardInterrupt:  # pytest would end all tests
        return "a traceback"
    except ModuleNotFoundError as error:
        if error.name != "embreex":
            raise
        pytest.skip("needs research/worlds/requirements.txt")
    return 0


def test_each_script_has_commands_here() -> None:
    assert sorted(SCRIPTS) == sorted(COMMANDS)


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("script", "words"),
    [(script, words) for script in SCRIPTS for words in COMMANDS.get(script, ())],
)
def test_bad_input_is_one_line_that_names_it(
    script: str,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert exit_code(script, words, monkeypatch) == 2
    line = capsys.readouterr().err
    assert re.fullmatch(r"error: .+\n", line)
    assert words.split()[-1].rpartition("=")[2] in line


@pytest.mark.parametrize("script", sorted(SCRIPTS))
def test_ctrl_c_ends_a_script_without_a_traceback(
    script: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*arguments: object) -> None:
        """Do what Ctrl-C does, while the options are read."""
        raise KeyboardInterrupt

    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", interrupt)
    assert exit_code(script, "", monkeypatch) == 130
    assert capsys.readouterr().err == "interrupted\n"
