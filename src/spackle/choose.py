"""A name for callers that have not moved to `spackle.bases.open` yet."""

from __future__ import annotations

from collections.abc import Callable

from spackle.bases.protocol import Base

Load = Callable[[], Base]
