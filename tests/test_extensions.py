"""The examples of extensions, named as `package.module:Name` in every command that takes them.

The folder of the examples is the working directory, where each file is a module.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.command import Run, decode, refuses, report_of, run
from helpers.evaluation_data import write_boxes
from helpers.photos import picture, write_depth, write_photo
from PIL import Image

from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.shards import load_manifest
from spackle.paper.evaluation.folder import load_run
from spackle.residual.architectures import load_residual

EXAMPLES = Path(__file__).parents[1] / "examples"
BASE = "04_own_base:Street"
INPAINTER = "06_own_inpainter:MeanColor"
METHOD = "13_evaluate_your_method:mean_color"
NETWORK = "16_own_network:SmallNet"
DATASET = "17_own_dataset:OWN_PAIRS"
MOST_LINES = 40  # of code in an example of an extension


@pytest.fixture(autouse=True)
def _in_the_folder_of_examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The examples are modules of the working directory, and are imported anew for each test."""
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(EXAMPLES)])
    yield
    for name in [name for name in sys.modules if name[:2].isdigit()]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo, two photos for training, and a stereo pair."""
    place = tmp_path_factory.mktemp("extensions")
    write_photo(place / "photo.png", 96, 72)
    (place / "photos").mkdir()
    for number in range(2):
        photo = Image.fromarray(np.rot90(picture(400, 360), number))
        photo.save(place / "photos" / f"{number}.png")
    write_boxes(place / "pairs" / "boxes", 0)
    return place


def succeeds(*words: object) -> Run:
    done = run(*words)
    assert done.code == 0, done.err
    return done


def evaluated(place: Path, output: Path, *words: object, dataset: str = "pairs") -> set[str]:
    """The names of the methods that an evaluation of large views has measured."""
    size = ("--dataset", dataset, "--disparity", 0.3, "--metrics", "none", "-o", output)
    succeeds("evaluate", place / "pairs", *size, *words)
    results = load_run(output)
    assert results.problems == {}
    return {row.method for row in results.measurements if row.metric == "har"}


def benched(place: Path, output: Path, *words: object, dataset: str = "pairs") -> None:
    size = ("--dataset", dataset, "--disparity", 0.3, "--runs", 1, "-o", output)
    succeeds("bench", place / "pairs", *size, *words)
    assert load_run(output).problems == {}


def built(place: Path, output: Path, *words: object) -> DatasetFiles:
    write_photo(place / "few" / "a.png", 96, 72)
    size = ("--views", 2, "--threads", 1, "--trajectory", "swipe", "--disparity", 0.3, 0.3)
    succeeds("dataset", "build", place / "few", "-o", output, *size, *words)
    return DatasetFiles(output)


def test_a_base(place: Path, tmp_path: Path) -> None:
    words = ("--base", BASE, "--disparity", 0.1, "--frames", 3)
    succeeds("predict", place / "photo.png", "-o", tmp_path, *words)
    assert report_of(tmp_path / "photo")["base"]["name"] == BASE
    files = built(place, tmp_path / "data", "--base", BASE, "--inpainter", "none")
    # The depths are between 2 and 20 m.
    assert float(files[0].base.means[:, 2].median()) == pytest.approx(11, abs=3)
    assert evaluated(place, tmp_path / "eval", "--base", BASE, "--methods", "base") == {"base"}
    benched(place, tmp_path / "bench", "--base", BASE)


def test_an_inpainter(place: Path, tmp_path: Path) -> None:
    depth = write_depth(tmp_path / "depth.npy")
    words = ("--depth", depth, "--fill", INPAINTER, "--frames", 3)
    succeeds("predict", write_photo(tmp_path / "photo.png"), "-o", tmp_path / "out", *words)
    assert report_of(tmp_path / "out" / "photo")["residual"]["fill"] == INPAINTER
    assert len(decode(tmp_path / "out" / "photo" / "video.mp4")) == 3

    group = built(place, tmp_path / "data", "--base", "lite", "--inpainter", INPAINTER)[0]
    view = group.view(1)
    painted = view.target[view.mask]
    assert len(painted) > 10
    assert float((painted - view.rendering.rgb[~view.mask].mean(dim=0)).abs().max()) < 0.01

    words = ("--base", "rgbd", "--methods", "base,inpaint2d", "--inpainter", INPAINTER)
    evaluated(place, tmp_path / "eval", *words)
    config = load_run(tmp_path / "eval").config
    assert config["inpainter"]["name"] == "mean"
    assert config["code"].keys() == {INPAINTER}


def test_a_method_and_a_dataset(place: Path, tmp_path: Path) -> None:
    words = ("--base", "rgbd", "--methods", f"base,paper,{METHOD}", "--protocol", "near-view")
    size = ("--dataset", "pairs", "--metrics", "psnr", "-o", tmp_path / "eval")
    succeeds("evaluate", place / "pairs", *size, *words)
    results = load_run(tmp_path / "eval")
    psnr = {row.method: float(row.value or 0) for row in results.measurements if row[5] == "psnr"}
    # Grey is nearer to the truth than black.
    assert psnr[METHOD] > psnr["base"] + 2

    folder = tmp_path / "own" / "pairs" / "garden"
    write_boxes(folder, 0)
    for old, new in (("left.png", "photo.png"), ("right.png", "second.png")):
        (folder / old).rename(folder / new)
    with Image.open(folder / "photo.png") as photo:
        width, height = photo.size
    np.save(folder / "depth.npy", np.full((height, width), 2, np.float32))
    numbers = {"width": width, "height": height, "focal_px": 60, "right_m": 0.2}
    (folder / "camera.json").write_text(json.dumps(numbers))
    own = ("--base", "rgbd", "--methods", "base")
    assert evaluated(tmp_path / "own", tmp_path / "own-eval", *own, dataset=DATASET) == {"base"}
    assert load_run(tmp_path / "own-eval").title == "My pairs"
    benched(tmp_path / "own", tmp_path / "own-bench", "--base", "rgbd", dataset=DATASET)


def test_a_network(place: Path, tmp_path: Path) -> None:
    data = (f"data.photos={place / 'photos'}", "data.views=3", "data.validation_views=1")
    steps = ("data.cells=16", "optim.steps=2", "optim.batch=2", f"network={NETWORK}")
    succeeds("train", "--recipe", "quick", "-o", tmp_path / "run", *data, *steps)
    weights = tmp_path / "run" / "best.safetensors"
    assert load_residual(weights).name == NETWORK

    use = ("--residual", weights, "--residual-network", NETWORK)
    depth = write_depth(tmp_path / "depth.npy")
    photo = write_photo(tmp_path / "photo.png")
    words = ("--depth", depth, "--no-render", "--disparity", 0.3)
    succeeds("predict", photo, "-o", tmp_path / "out", *words, *use)
    methods = ("--base", "rgbd", "--methods", "paper")
    assert evaluated(place, tmp_path / "eval", *methods, *use) == {"paper"}
    benched(place, tmp_path / "bench", "--base", "rgbd", *use)

    # The file alone does not choose which code runs: a new process has not imported the module.
    command = ["predict", photo, "-o", tmp_path / "no", *words, "--residual", weights]
    done = subprocess.run(
        [sys.executable, "-m", "spackle", *map(str, command)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2
    assert f"add --residual-network {NETWORK}" in done.stderr.splitlines()[-1]


def test_changed_code_is_another_result(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = (EXAMPLES / "04_own_base.py").read_text()

    def predict_again(code: str) -> Run:
        (tmp_path / "my_base.py").write_text(code)
        sys.modules.pop("my_base", None)
        words = ("--base", "my_base:Street", "--no-render", "-o", tmp_path / "out")
        return succeeds("predict", tmp_path / "photos", "--disparity", 0.1, *words)

    write_photo(tmp_path / "photos" / "photo.png", 96, 72)

    predict_again(code)
    scene = tmp_path / "out" / "photo" / "scene.ply"
    first = scene.read_bytes()
    assert "already" in predict_again(code).err
    assert scene.read_bytes() == first
    predict_again(code.replace("linspace(20, 2,", "linspace(30, 3,"))
    assert scene.read_bytes() != first
    sys.modules.pop("my_base")


def test_the_command_finds_modules_of_the_working_directory(place: Path, tmp_path: Path) -> None:
    (tmp_path / "my_base.py").write_text((EXAMPLES / "04_own_base.py").read_text())
    # A module of the same name as an installed one does not take its place.
    (tmp_path / "rich.py").write_text("raise RuntimeError('the wrong module')")
    words = ["predict", place / "photo.png", "--base", "my_base:Street", "--no-render"]
    code = "import sys; from spackle.cli import main; sys.argv[0] = 'spackle'; main()"
    # -P: as for the installed command, the working directory is not on the path.
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *map(str, words), "-o", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ},
    )
    assert done.returncode == 0, done.stderr
    assert report_of(tmp_path / "out" / "photo")["base"]["name"] == "my_base:Street"


WRONG: list[tuple[str, str]] = [
    ("--base 04_own_base:Stret", "04_own_base has no Stret: did you mean Street?"),
    ("--base 04_own_bas:Street", "cannot import 04_own_bas: "),
    ("--base 04_own_bas:Street", "did you mean 04_own_base?"),
    ("--base 04_own_base.Street", "did you mean 04_own_base:Street?"),
    ("--base 04_own_base:main", "has no predict: write a class like spackle.bases.Base"),
    ("--base sharpe", "did you mean sharp?"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_a_wrong_base_is_one_line(place: Path, tmp_path: Path, words: str, message: str) -> None:
    out = ("-o", tmp_path / "out")
    refuses(run("predict", place / "photo.png", *words.split(), *out), "--base", message)
    refuses(run("dataset", "build", place / "photos", *words.split(), *out), message)
    pairs = (place / "pairs", "--dataset", "pairs", *words.split(), *out)
    refuses(run("evaluate", *pairs), message)
    refuses(run("bench", *pairs), message)
    assert not (tmp_path / "out").exists()


def test_other_wrong_names_are_one_line(place: Path, tmp_path: Path) -> None:
    out = ("-o", tmp_path / "out")
    pairs = ("evaluate", place / "pairs", "--dataset", "pairs", "--base", "rgbd", *out)
    refuses(run(*pairs, "--inpainter", "exemplr"), "--inpainter exemplr", "did you mean exemplar?")
    wrong_class = INPAINTER.replace("Color", "Colour")
    refuses(run(*pairs, "--inpainter", wrong_class), "did you mean MeanColor?")
    refuses(run(*pairs, "--inpainter", "06_own_inpainter:Tensor"), "has no version: write a class")
    refuses(run(*pairs, "--methods", "spackl"), "--methods spackl", "did you mean spackle?")
    refuses(run(*pairs, "--methods", METHOD[:-1]), "did you mean mean_color?")
    refuses(run(*pairs, "--methods", METHOD.replace(":", ".")), f"did you mean {METHOD}?")
    refuses(run(*pairs, "--residual-network", NETWORK[:-1]), "did you mean SmallNet?")
    build = ("dataset", "build", place / "photos", "--base", "lite", *out)
    refuses(run(*build, "--inpainter", "lamma"), "--inpainter lamma", "did you mean lama?")
    refuses(run(*build, "--inpainter", wrong_class), "did you mean MeanColor?")
    predict = ("predict", place / "photo.png", "--base", "lite", *out)
    refuses(run(*predict, "--fill", "exemplr"), "--fill exemplr", "did you mean exemplar?")
    refuses(run(*predict, "--fill", wrong_class), "did you mean MeanColor?")
    train = ("train", "--recipe", "quick", f"data.photos={place / 'photos'}", *out)
    refuses(run(*train, f"network={NETWORK[:-1]}"), "did you mean SmallNet?")
    refuses(run(*train, "network=16_own_network:Path"), "not a subclass of spackle.residual")
    assert not (tmp_path / "out").exists()


def lines_of_code(text: str) -> int:
    """The number of lines with code: neither empty nor comments or docstrings."""
    lines = set()
    begins_statement = True
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT):
            begins_statement = True
        elif token.type not in (tokenize.NL, tokenize.COMMENT, tokenize.ENDMARKER):
            is_docstring = token.type == tokenize.STRING and begins_statement
            if not is_docstring:
                lines.update(range(token.start[0], token.end[0] + 1))
            begins_statement = False
    return len(lines)


@pytest.mark.parametrize("number", [4, 6, 13, 16, 17, 18])
def test_an_example_of_an_extension_is_short(number: int) -> None:
    (file,) = EXAMPLES.glob(f"{number:02}_*.py")
    assert lines_of_code(file.read_text(encoding="utf-8")) <= MOST_LINES


def test_a_dataset_records_the_code_of_its_inpainter(place: Path, tmp_path: Path) -> None:
    built(place, tmp_path / "data", "--base", BASE, "--inpainter", INPAINTER)
    config = load_manifest(tmp_path / "data").config
    assert config["inpainter"]["code"].keys() == {INPAINTER}
    code = (EXAMPLES / "04_own_base.py").read_bytes()
    assert config["base"]["weights"] == hashlib.sha256(code).hexdigest()
