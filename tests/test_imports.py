"""Imports: between rooms, of optional packages, and with the core dependencies alone."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import spackle

SOURCES = Path(spackle.__file__).parent
FILES = sorted(SOURCES.rglob("*.py"))

OPTIONAL = (
    "gsplat",
    "transformers",
    "pyiqa",
    "propainter",
    "viser",
    "skimage",
    "yaml",
    "tensorboard",
)
OPTIONAL += ("cv2", "fsspec", "pytorchcv", "torchvision", "OpenEXR", "prometheus_client")

# The rooms from the first to the last: a room imports only from itself and from rooms above it in
# this list. "top" are the files of the pipeline beside the rooms.
ROOMS = (
    "runtime",
    "core",
    "weights",
    "render",
    "depth",
    "lifting",
    "bases",
    "inpaint",
    "residual",
    "scene_fill",
    "formats",
    "video",
    "top",
    "results",
    "posed",
    "clips",
    "paper",
    "web",
    "cli",
)
TOP_FILES = {"__init__", "__main__", "api", "pipeline", "scene", "views"}
# Beyond the order: what else a room must not import.
FORBIDDEN = {
    "residual": {"inpaint", "core.patch_matching"},  # the paper and nothing else
    "paper": {"clips"},
    "web": {"clips", "paper"},
}

WITHOUT_OPTIONAL = """
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys(sys.argv[1:]))  # None lets the import of such a module fail
import spackle
modules = pkgutil.walk_packages(spackle.__path__, "spackle.")
names = [m.name for m in modules if not m.name.endswith("__main__")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def module_of(path: Path) -> str:
    parts = path.relative_to(SOURCES.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    first = [*module.split(".")[1:], ""][0]
    return first if first in ROOMS else "top"


@functools.cache
def imports_of(path: Path) -> tuple[str, ...]:
    """Every module that a file imports, also within functions; `from a import b` counts as a.b if
    a.b is a module. Each file is parsed once for all tests.
    """
    return tuple(_imports_of(path))


def _imports_of(path: Path) -> Iterator[str]:
    """The modules of `imports_of`, one after the other."""
    package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = (
                package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            )
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = SOURCES.parent.joinpath(*source.split("."), alias.name)
                yield (
                    f"{source}.{alias.name}"
                    if inner.with_suffix(".py").is_file() or inner.is_dir()
                    else source
                )


def test_the_top_level_has_six_files_and_every_room_is_known() -> None:
    assert {path.stem for path in SOURCES.glob("*.py")} == TOP_FILES
    folders = {path.parent.name for path in SOURCES.glob("*/__init__.py")}
    assert folders == set(ROOMS) - {"top"}


def test_a_room_imports_only_from_rooms_above_it() -> None:
    wrong = []
    for path in FILES:
        if path.parent == SOURCES and path.name in ("__init__.py", "__main__.py"):
            continue
        room = room_of(module_of(path))
        for module in imports_of(path):
            if not module.startswith("spackle."):
                continue
            other = room_of(module)
            forbidden = FORBIDDEN.get(room, set())
            if ROOMS.index(other) > ROOMS.index(room) or forbidden & {
                other,
                module.removeprefix("spackle."),
            }:
                wrong.append(f"{path} ({room}) imports {module} ({other})")
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other_in_a_circle() -> None:
    ours = {
        module_of(path): path
        for path in FILES
        if path.parent != SOURCES or path.name != "__init__.py"
    }
    waiting = {module: {m for m in imports_of(path) if m in ours} for module, path in ours.items()}
    while free := {module for module, needs in waiting.items() if not needs & set(waiting)}:
        waiting = {module: needs for module, needs in waiting.items() if module not in free}
    assert not waiting, f"in a circle, or behind one: {sorted(waiting)}"


@pytest.mark.parametrize("package", OPTIONAL)
def test_each_optional_package_is_wrapped_by_one_file(package: str) -> None:
    users = [
        path for path in FILES if any(m.partition(".")[0] == package for m in imports_of(path))
    ]
    assert len(users) <= (2 if package == "skimage" else 1), users


@pytest.mark.journey
def test_every_module_imports_without_optional_packages() -> None:
    command = [sys.executable, "-c", WITHOUT_OPTIONAL, *OPTIONAL]
    assert (
        int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        == len(FILES) - 2
    )
