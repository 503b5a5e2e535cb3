"""The same examples in every run; HYPOTHESIS_PROFILE=explore looks for new ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Before torch is loaded: its idle threads would spin, which makes tests that run beside each other slow.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

settings.register_profile("repeat", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeat"))


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """A small photo and its depth map."""
    from photos import write_pair

    return write_pair(tmp_path)
