"""Signals that end a long job between two steps."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# As `timeout` ends a process and its group: the second signal comes while the first one is noted.
TWICE = """
import os, signal, sys, time
from spackle.progress import asked_to_stop
def again(frame, event, argument):
    name = argument.__name__ if event == "c_call" else frame.f_code.co_name
    if event in ("call", "c_call") and name in ("notify_all", "append"):  # of an Event, of a list
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGTERM)
with asked_to_stop(alone=True) as stopped:
    sys.setprofile(again)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)
    print(stopped())
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_two_signals_at_a_time_end_a_job_as_one_does() -> None:
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr
