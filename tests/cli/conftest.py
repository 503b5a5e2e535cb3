"""A prediction that the tests of commands share."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.command import Run, predicted
from helpers.photos import write_pair


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """The folder of the prediction, which no test may change, and the command's output."""
    folder = tmp_path_factory.mktemp("plain")
    result = predicted(*write_pair(folder), folder / "out")
    return folder / "out" / "photo", result


@pytest.fixture(scope="session")
def scene(plain: tuple[Path, Run]) -> Path:
    return plain[0] / "scene.ply"
