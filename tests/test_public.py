"""The public names; a change of these lists needs a line in CHANGELOG.md."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

import spackle
from spackle.cli import app

ROOT = Path(__file__).parents[1]
PYTHON = """
Base BasePrediction Camera Cancelled DepthMap FillContext Gaussians HfBase InputError LiteBase
MogeBase Photo PosedScene Renderer Rendering Scene SceneReport SharpBase Spackle StageProgress
complete complete_view fill fill_scene fill_view get_renderer hole_area_ratio hole_mask
load_cameras load_depth load_photo load_ply marked_gaussians predict predict_posed remove
save_ply
"""
COMMANDS = """
bench; dataset build; dataset info; dataset preview; dataset verify; demo; evaluate; export;
figures; fill; info; predict;
render; serve; tables; train; view; weights get; weights list
"""


def leaves(command: object, name: str = "") -> list[str]:
    if not isinstance(command, TyperGroup):
        return [name]
    return [
        leaf
        for word, below in command.commands.items()
        for leaf in leaves(below, f"{name} {word}".strip())
    ]


def test_the_public_names_are_these() -> None:
    assert spackle.__all__ == PYTHON.split()
    assert sorted(leaves(get_command(app))) == [
        " ".join(name.split()) for name in COMMANDS.split(";")
    ]


@pytest.mark.parametrize("name", spackle.__all__)
def test_public_functions_are_annotated_without_any(name: str) -> None:
    thing = getattr(spackle, name)
    methods = (
        [value for key, value in vars(thing).items() if not key.startswith("_")]
        if inspect.isclass(thing)
        else []
    )
    for function in filter(inspect.isfunction, [thing, *methods, getattr(thing, "__init__", None)]):
        signature = inspect.signature(function)
        types = [
            signature.return_annotation,
            *(value.annotation for value in signature.parameters.values()),
        ]
        assert not [kind for kind in types if re.search(r"\bAny\b", str(kind))], function


def test_tag_changelog_and_code_are_of_one_version() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", spackle.__version__)
    heads = re.findall(
        r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert heads[0] in ("Unreleased", spackle.__version__)
