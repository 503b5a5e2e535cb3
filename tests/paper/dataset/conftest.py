"""Small photos with depth maps, and a dataset of these photos."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.dataset_builds import build, write_inputs


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_inputs(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="module")
def whole(place: Path) -> Path:
    """A dataset built by one process without interruption."""
    done = build(place, place / "whole")
    assert done.code == 0, done.err
    return place / "whole"


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    """A copy of the dataset, which tests may damage."""
    return shutil.copytree(whole, tmp_path / "copy")
