"""What the site has besides docs/: pages from elsewhere in the repository, and the reference.

The reference is made of the code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import spackle

ROOT = Path(__file__).parents[1]
ELSEWHERE = {
    "architecture.md": "ARCHITECTURE.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
    "comfyui.md": "integrations/comfyui/README.md",
    "weights.md": "src/spackle/weights/README.md",
    "residual-card.md": "src/spackle/weights/residual.md",
    "lite-card.md": "src/spackle/weights/lite.md",
}
CODE = {
    "python.md": "src/spackle/__init__.py",
    "commands.md": "src/spackle/cli/__init__.py",
}  # what a page is made of
COMMANDS = ("predict", "view", "render", "export", "info", "demo", "weights get", "weights list")
COMMANDS += (
    "train",
    "dataset build",
    "dataset info",
    "dataset verify",
    "dataset preview",
    "evaluate",
    "tables",
)
COMMANDS += ("bench",)
EXAMPLE = re.compile(
    r"^`(examples/\w+\.py)`$", re.MULTILINE
)  # what a line with nothing but a link becomes
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that docs/ does not hold."""
    pages = {
        page: (ROOT / source).read_text(encoding="utf-8") for page, source in ELSEWHERE.items()
    }
    pages |= {"commands.md": _commands(), "python.md": _python()}
    for page, text in pages.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to pages of the site; what is not on it stays as words."""
    here = page.file.src_uri
    source = ROOT / ELSEWHERE.get(here, f"docs/{here}")
    moved = {(ROOT / place).resolve(): name for name, place in (ELSEWHERE | CODE).items()}

    def lead(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        file, hash_, section = target.partition("#")
        if "://" in target or not file:
            return found[0]
        place = (source.parent / file).resolve()
        name = moved.get(place) or (
            place.relative_to(ROOT / "docs").as_posix()
            if place.is_relative_to(ROOT / "docs")
            else ""
        )
        if not name or place.is_dir():
            return words
        return f"{picture}[{words}]({os.path.relpath(name, Path(here).parent)}{hash_}{section})"

    return EXAMPLE.sub(_code, LINK.sub(lead, markdown))


def _code(found: re.Match[str]) -> str:
    """An example, in place of its name."""
    return f'```python title="{found[1]}"\n{(ROOT / found[1]).read_text(encoding="utf-8")}```'


def _commands() -> str:
    """The help of every command, with all options."""
    parts = [
        "# Commands\n\nAll options, as `--help` prints them, and `--help-all` of `predict` "
        "and `render`.\n"
    ]
    for name in COMMANDS:
        whole = "--help-all" if name in ("predict", "render") else "--help"
        command = [sys.executable, "-m", "spackle", *name.split(), whole]
        environment = {**os.environ, "COLUMNS": "100", "PYTHONPATH": str(ROOT / "src")}
        text = subprocess.run(
            command, capture_output=True, text=True, check=True, env=environment
        ).stdout
        help_text = text.replace("python -m spackle", "spackle").strip()
        parts.append(f"## spackle {name}\n\n```text\n{help_text}\n```\n")
    return "\n".join(parts)


def _python() -> str:
    """Every public name of the package, by its docstring."""
    parts = [
        "# Python\n\nWhat `import spackle` gives. Conventions: [architecture](architecture.md).\n"
    ]
    first = ["predict", "Scene", "complete"]
    for name in [*first, *(name for name in spackle.__all__ if name not in first)]:
        parts.append(f"::: {spackle._MODULE_OF_NAME[name]}.{name}\n")
    return "\n".join(parts)
