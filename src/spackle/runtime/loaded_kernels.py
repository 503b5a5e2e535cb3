"""Loads all of numba when it is imported, for processes that are forked afterwards.

Importing numba is not enough: it loads most of itself, for seconds, when a kernel is called first.
"""

from __future__ import annotations

import contextlib

from spackle.runtime.kernels import kernel


@kernel
def _same(number: int) -> int:
    """The number itself."""
    return number


# No thread starts, so that the process can still be forked. What fails here, such as a missing
# compiler cache, fails again in the process that needs a kernel, and is told there.
with contextlib.suppress(Exception):
    _same(0)
