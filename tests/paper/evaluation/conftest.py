"""Small scenes for evaluations."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.evaluation_data import write_boxes


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes in Middlebury's folders."""
    root = tmp_path_factory.mktemp("middlebury")
    for seed, name in enumerate(("Ball", "Chair", "Door")):
        write_boxes(root / name, seed)
    return root
