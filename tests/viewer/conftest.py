"""A photo, as the page sends it."""

from __future__ import annotations

import pytest
from photos import write_photo


@pytest.fixture(scope="session")
def photo(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_photo(tmp_path_factory.mktemp("photo") / "photo.png").read_bytes()
