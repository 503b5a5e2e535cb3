"""Marks of tests that need what not every operating system has."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

#: For tests that kill a process or a group of processes: Windows has neither SIGKILL nor groups.
needs_posix_signals = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows has no POSIX signals"
)
#: For tests that read the open files, threads and memory of this process.
needs_proc = pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="this system has no folder /proc"
)
