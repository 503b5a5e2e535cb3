"""The scoreboard finds, in the package, every mechanism that it can switch off."""

from __future__ import annotations

import pytest
import scoreboard

import spackle.pipeline  # noqa: F401  # its imports hold all mechanisms


@pytest.mark.parametrize("name", scoreboard.MECHANISMS)
def test_every_mechanism_is_in_the_package(name: str) -> None:
    for target in {**scoreboard.LIFT, **scoreboard.FILL}[name]:
        assert scoreboard.holders(target)
