"""The shortest programs of the documentation work as they stand."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.command import decode
from helpers.photos import HEIGHT, WIDTH, write_depth, write_photo

import spackle


def documented() -> list[str]:
    """The examples in the package's docstring and in the README."""
    assert spackle.__doc__ is not None
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in readme.split("```python\n")[1:]]
    return [spackle.__doc__[spackle.__doc__.index("import spackle") :], *blocks]


@pytest.mark.parametrize("code", documented(), ids=lambda code: f"{len(code)} characters")
def test_the_documented_three_lines_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    assert len([line for line in code.splitlines() if line]) == 3
    write_photo(tmp_path / "photo.jpg")
    write_depth(tmp_path / "depth.png")
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    frames = decode(Path("video.mp4"))
    assert len(frames) == 120  # 4 seconds
    assert (frames[0].width, frames[0].height) == (WIDTH, HEIGHT)
