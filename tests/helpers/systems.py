"""Marks of tests that need what not every operating system has."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

#: For tests that kill a process or a group of processes: Windows has neither SIGKILL nor groups.
needs_posix_signals = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows has no POSIX signals"
)
#: For tests that make a named pipe, which is a kind of file that Windows does not have.
needs_named_pipes = pytest.mark.skipif(
    not hasattr(os, "mkfifo"), reason="this system has no named pipes among its files"
)
#: For tests that write to a full disk.
needs_full_device = pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
#: For tests that read the open files, threads and memory of this process.
needs_proc = pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="this system has no folder /proc"
)
