"""The commands of the quick start work with the wheel in a new environment, outside of the
checkout.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
from helpers import DATA
from helpers.command import page_of
from helpers.photos import write_photo

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "quick-start.md").read_text(encoding="utf-8")
SHORTER = {
    "train": [
        *("optim.steps=3", "optim.warmup=1", "optim.batch=1", "run.validate_every=3"),
        *("data.views=4", "data.validation_views=1", "data.cells=16"),
    ]
}
SHORTER |= {"predict": ["--frames", "4"], "render": ["--frames", "4"]}
ALONE = {
    name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "NUMBA"))
}


def commands() -> list[list[str]]:
    blocks = re.findall(r"^```bash\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return [
        shlex.split(line, comments=True)[1:]
        for line in "".join(blocks).splitlines()
        if line.startswith("spackle ")
    ]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an environment's programs; SPACKLE_EMPTY=1 lets pip install dependencies, which
    else are borrowed.
    """
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(
        ROOT,
        folder / "source",
        ignore=shutil.ignore_patterns(".*", "node_modules", "tests", "docs"),
    )
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    empty = os.environ.get("SPACKLE_EMPTY") == "1"
    build = [
        *pip,
        "wheel",
        "--no-deps",
        *([] if empty else ["--no-build-isolation"]),
        "-w",
        folder,
        folder / "source",
    ]
    if not empty:
        pytest.importorskip("setuptools", "77", reason="builds the wheel")
    subprocess.run(build, check=True, timeout=300, env=ALONE)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv")
    python = folder / "venv" / "bin" / "python"
    wanted = ["--no-deps", "--no-index", "--no-compile", wheel]
    if empty:
        wanted = ["--constraint", ROOT / "constraints.txt", f"{wheel}[train]"]
    subprocess.run(
        [*pip, "--python", python, "install", *wanted], check=True, timeout=1800, env=ALONE
    )
    if not empty:
        (own,) = (folder / "venv" / "lib").glob("python*/site-packages")
        (own / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
        share_kernels(own / "spackle")
    return python.parent


def share_kernels(installed: Path) -> None:
    """Let an installed package and the checkout keep their compiled kernels in the same place.

    Numba keeps them beside a source file, and compiles again where the file's size or time is
    another. To compile all of them once more takes a minute and a half.
    """
    for source in (ROOT / "src" / "spackle").rglob("*.py"):
        copy = installed / source.relative_to(ROOT / "src" / "spackle")
        assert copy.read_bytes() == source.read_bytes()
        times = source.stat()
        os.utime(copy, ns=(times.st_atime_ns, times.st_mtime_ns))

        kernels = copy.parent / "__pycache__"
        if not kernels.is_symlink():
            shutil.rmtree(kernels, ignore_errors=True)
            (source.parent / "__pycache__").mkdir(exist_ok=True)
            kernels.symlink_to(source.parent / "__pycache__")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place")
    for name, width in (
        ("photo.jpg", 160),
        ("photos/a.png", 160),
        ("photos/b.png", 170),
        ("photos/c.png", 180),
    ):
        write_photo(folder / name, width, 120)
    return folder


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_each_command_of_the_quick_start_works(
    environment: Path, place: Path, words: list[str]
) -> None:
    command = [environment / "spackle", *words, *SHORTER.get(words[0], [])]
    if words[0] == "view":
        assert b"<canvas" in page_of([*command, "--no-open"], cwd=place, env=ALONE)
        return
    done = subprocess.run(
        command, cwd=place, env=ALONE, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    for file in re.findall(r"-o (\S+)", " ".join(words)):
        assert (place / file).exists()


def test_the_python_of_the_quick_start_works_by_the_wheel(environment: Path, place: Path) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    code = "\n".join([*blocks, "print(len(spz) > 1000, spackle.__file__)"])
    out = subprocess.check_output(
        [environment / "python", "-c", code], cwd=place, env=ALONE, text=True, timeout=600
    )
    large, _, home = out.strip().partition(" ")
    assert (large, Path(home).is_relative_to(environment.parent)) == ("True", True)
    assert (place / "video.mp4").is_file()


@pytest.mark.slow
def test_programs_are_type_checked_by_the_wheel(environment: Path, tmp_path: Path) -> None:
    program = Path(shutil.copy(DATA / "typed_program.py", tmp_path))
    options = ["--strict", "--no-error-summary", "--python-executable", environment / "python"]
    checker = [sys.executable, "-m", "mypy", *options, program]
    done = subprocess.run(
        checker, cwd=tmp_path, env=ALONE, capture_output=True, text=True, timeout=600
    )
    found = re.findall(
        r"^typed_program\.py:(\d+): error: .*\[([a-z-]+)\]$", done.stdout, re.MULTILINE
    )
    lines = enumerate(program.read_text(encoding="utf-8").splitlines(), 1)
    wrong = [
        (str(number), words[1])
        for number, line in lines
        if len(words := line.rsplit("  # ", 1)) == 2
    ]
    assert len(wrong) == 5
    assert found == wrong, done.stdout
