"""Imports: between rooms, of optional packages, and with the core dependencies alone."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import spackle

SOURCES = Path(spackle.__file__).parent
FILES = sorted(SOURCES.rglob("*.py"))

OPTIONAL = ("gsplat", "transformers", "pyiqa", "propainter", "viser", "skimage", "yaml", "tensorboard")
OPTIONAL += ("cv2", "fsspec", "pytorchcv", "torchvision")

# For each room the rooms that it may import. Modules at the top that are not named here belong to the room "values".
BELOW_SCENE = {"values", "render", "bases", "inpaint", "residual", "scene_fill", "formats", "weights"}
SCENE = {"pipeline", "scene", "session", "views", "video_frames", "photo_results"}
BELOW_DATASET = {*BELOW_SCENE, "scene"}
ALLOWED: dict[str, set[str]] = {
    "values": set(),
    "weights": {"values"},
    "formats": {"values"},
    "render": {"values"},
    "bases": {"values", "weights"},
    "inpaint": {"values", "weights"},
    "residual": {"values", "render", "bases"},
    "scene_fill": {"values", "render", "residual", "inpaint"},
    "clips": {"values", "render", "bases", "residual", "scene_fill", "inpaint", "formats"},
    "web": {*BELOW_SCENE, "scene"},
    "scene": BELOW_SCENE,
    "workers": {"values"},
    "dataset": {*BELOW_DATASET, "workers"},
    "training": {*BELOW_DATASET, "dataset"},
    "evaluation": {*BELOW_DATASET, "dataset", "training"},
    "app": {*BELOW_DATASET, "evaluation"},
    "cli": {*BELOW_DATASET, "dataset", "training", "evaluation", "web", "app", "workers", "clips"},
}

WITHOUT_OPTIONAL = """
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys(sys.argv[1:]))  # None lets the import of such a module fail
import spackle
names = [m.name for m in pkgutil.walk_packages(spackle.__path__, "spackle.") if not m.name.endswith("__main__")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def module_of(path: Path) -> str:
    parts = path.relative_to(SOURCES.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    first = [*module.split(".")[1:], ""][0]
    if first in SCENE:
        return "scene"
    return first if first in ALLOWED or (SOURCES / first).is_dir() else "values"


def imports_of(path: Path) -> Iterator[str]:
    """Every module that a file imports, also within functions; `from a import b` counts as a.b if a.b is a module."""
    package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = SOURCES.parent.joinpath(*source.split("."), alias.name)
                yield f"{source}.{alias.name}" if inner.with_suffix(".py").is_file() or inner.is_dir() else source


def test_a_room_imports_only_allowed_rooms() -> None:
    wrong = []
    for path in FILES:
        if path.parent == SOURCES and path.name in ("__init__.py", "__main__.py"):
            continue
        room = room_of(module_of(path))
        assert room in ALLOWED, f"{room}: not in ALLOWED"
        for module in imports_of(path):
            other = room_of(module)
            if module.startswith("spackle.") and other not in ALLOWED[room] | {room}:
                wrong.append(f"{path} ({room}) imports {module} ({other})")
    assert not wrong, "\n".join(wrong)


def test_no_two_classes_have_one_name() -> None:
    homes: dict[str, list[str]] = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(str(path))
    assert not {name: files for name, files in homes.items() if len(files) > 1}


def test_no_modules_import_each_other_in_a_circle() -> None:
    ours = {module_of(path): path for path in FILES if path.parent != SOURCES or path.name != "__init__.py"}
    waiting = {module: {m for m in imports_of(path) if m in ours} for module, path in ours.items()}
    while free := {module for module, needs in waiting.items() if not needs & set(waiting)}:
        waiting = {module: needs for module, needs in waiting.items() if module not in free}
    assert not waiting, f"in a circle, or behind one: {sorted(waiting)}"


@pytest.mark.parametrize("package", OPTIONAL)
def test_each_optional_package_is_wrapped_by_one_file(package: str) -> None:
    users = [path for path in FILES if any(m.partition(".")[0] == package for m in imports_of(path))]
    assert len(users) <= (2 if package == "skimage" else 1), users


def test_every_module_imports_without_optional_packages() -> None:
    command = [sys.executable, "-c", WITHOUT_OPTIONAL, *OPTIONAL]
    assert int(subprocess.run(command, capture_output=True, text=True, check=True).stdout) == len(FILES) - 2


# Modules that a reader of the pipeline may skip: other bases, phones' depth, the page, clips, video frames.
ASIDE = ("bases.lite", "bases.hf", "bases.moge", "bases.photo_depth", "formats.html", "clips", "video_frames")
MOST_FILES, MOST_LINES = 50, 9_700  # may only be lowered


def test_the_way_from_photo_to_scene_stays_short() -> None:
    ahead, reached = ["spackle.pipeline"], dict[str, Path]()
    while ahead:
        module = ahead.pop()
        path = SOURCES.parent.joinpath(*module.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        aside = any(f"{module}.".startswith(f"spackle.{room}.") for room in ASIDE)
        if module not in reached and path.is_file() and not aside:
            reached[module] = path
            ahead += [name for name in imports_of(path) if name.startswith("spackle.")]
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in reached.values())
    assert 40 < len(reached) <= MOST_FILES, sorted(reached)
    assert lines <= MOST_LINES
