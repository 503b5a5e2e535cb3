"""What every worker process needs; the process that is forked for each of them imports it once."""

from __future__ import annotations

import spackle.web.work  # noqa: F401
