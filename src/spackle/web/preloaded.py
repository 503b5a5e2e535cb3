"""What every worker process needs; the process that is forked for each of them imports it once."""

from __future__ import annotations

import contextlib

import torch

import spackle.web.work  # noqa: F401
from spackle.core.color import to_uint8

# At its first call, a compiled kernel loads all of numba, which takes seconds. A picture of one
# pixel starts no thread, so that the process can still be forked. What fails here fails again in
# the worker that needs it, and is told there.
with contextlib.suppress(Exception):
    to_uint8(torch.zeros(1, 1, 3))
