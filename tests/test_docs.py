"""The docs name existing functions, files, links and options."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from spackle.cli import app
from spackle.paper.demo import RESULT_FILES

ROOT = Path(__file__).parents[1]
FOLDERS = ("docs", "integrations", "research", "src")
PAGES = sorted(
    [*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))]
)


def names_in(path: Path) -> set[str]:
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        names |= {str(getattr(target, "name", getattr(target, "id", ""))) for target in targets}
    return names


def test_the_architecture_names_existing_files_and_functions() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    found = re.findall(r"`([\w/]+\.(?:py|yaml))(?::(\w+))?`", text)
    assert len(found) > 30
    for file, name in found:
        path = (
            ROOT / file
            if file.startswith(("tests/", "research/", "examples/"))
            else ROOT / "src" / "spackle" / file
        )
        assert path.is_file(), file
        assert not name or name in names_in(path), f"{file}:{name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r'(?:\]\(|src=")([^)"\s]+)', page.read_text(encoding="utf-8")):
        target, _, section = link.partition("#")
        if "://" in link:
            continue
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), link
        if section and path.suffix == ".md":
            titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert section in {
                re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
            }, link


def commands() -> list[str]:
    """Every `spackle` command in the docs."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    lines = re.sub(r"\\\n\s*", "", "\n".join(blocks)).splitlines()
    return sorted(
        {line.partition(" #")[0].strip() for line in lines if line.startswith("spackle ")}
    )


@pytest.mark.parametrize("line", commands())
def test_the_command_line_accepts_the_commands_in_the_docs(line: str) -> None:
    words, command = shlex.split(line)[1:], get_command(app)
    while isinstance(command, TyperGroup):
        command = command.commands[words.pop(0)]
    command.make_context(line, words)


def test_the_first_block_of_the_readme_can_be_typed_in_its_order() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    block = readme.partition("```bash\n")[2].partition("```")[0]
    commands = [shlex.split(line, comments=True) for line in block.splitlines() if line]
    # Nothing is there before but a checkout: its make installs, and the environment is opened.
    assert [words[0] for words in commands[:2]] == ["make", "."]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert f"\n{commands[0][1]}: $(VENV)/" in makefile
    written = {f"demo-output/{name}" for name in RESULT_FILES}
    for words in commands[2:]:
        assert words[0] == "spackle"
        assert words[2] in written, "no command before has written it"
        if words[1] == "predict":
            folder = f"{words[words.index('-o') + 1]}/{Path(words[2]).stem}"
            written |= {f"{folder}/{name}" for name in ("scene.ply", "video.mp4", "report.json")}
    assert len(commands) == 4
