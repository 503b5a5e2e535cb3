"""Worker processes: orders wait for their turn, may be cancelled, and end at their limits."""

from __future__ import annotations

import contextlib
import errno
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.lane_work import work
from helpers.systems import needs_proc

from spackle.runtime.errors import InputError
from spackle.runtime.lanes import Lane
from spackle.runtime.task_process import (
    CANCELLED,
    STARTS_QUICKLY,
    WORKER_DIED,
    TaskFailure,
    TaskLimits,
    TaskProcess,
    machine_fault,
    machine_memory,
)


@pytest.fixture
def lane() -> Iterator[Lane]:
    with contextlib.closing(Lane(work, 1)) as lane:
        yield lane


def outcome(lane: Lane, kind: str, value: Any = None, **limits: Any) -> TaskFailure | None:
    """How a task of an order ends."""
    order = lane.submit("a", lambda order: order.do((kind, value), dict, TaskLimits(**limits)))
    return order.outcome.result()


def test_a_failure_says_whose_fault_it_is(lane: Lane) -> None:
    assert outcome(lane, "nothing") is None
    assert outcome(lane, "refuse") == TaskFailure("input", "a.png: no photo")
    assert outcome(lane, "disk") == TaskFailure("machine", "No space left")
    assert outcome(lane, "bug", "oh") == TaskFailure("bug", "internal error: KeyError: 'oh'")
    assert outcome(lane, "die") == TaskFailure("died", WORKER_DIED)
    assert outcome(lane, "torch") == TaskFailure("memory", "needs more memory than it may take")
    assert outcome(lane, "network") == TaskFailure(
        "memory", "not enough memory: give a smaller model"
    )
    assert outcome(lane, "nothing") is None


def test_a_task_ends_at_its_limits_and_the_next_one_begins(lane: Lane) -> None:
    assert outcome(lane, "wait", seconds=0.2) == TaskFailure(
        "time", "took longer than 0.2 seconds, the limit"
    )
    too_much = outcome(lane, "compute", cpu_seconds=0)
    assert too_much is not None
    assert too_much.kind == "time"
    assert outcome(lane, "nothing", seconds=60) is None


@needs_proc
def test_memory_has_a_limit_that_ends_with_the_task(lane: Lane) -> None:
    size = 200_000_000
    too_much = outcome(lane, "allocate", size, memory_bytes=size // 4)
    assert too_much is not None
    assert too_much.kind == "memory"
    assert outcome(lane, "allocate", size) is None


def test_the_memory_of_a_machine_is_that_of_its_container(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = (tmp_path / "memory.max", tmp_path / "missing")
    monkeypatch.setattr("spackle.runtime.task_process.CONTAINER_LIMIT_FILES", files)
    files[0].write_text("max\n")
    whole = machine_memory()
    if whole is None:
        pytest.skip("this system does not say how much memory there is")
    assert whole > 100_000_000
    files[0].write_text("50000000\n")
    assert machine_memory() == 50_000_000


def test_orders_wait_in_line_and_end_with_their_owner(lane: Lane) -> None:
    has_begun = threading.Event()
    running = lane.submit("a", lambda order: order.do(("wait", 0), lambda event: has_begun.set()))
    assert has_begun.wait(120)
    second = lane.submit("b", lambda order: order.do(("nothing", 0), dict))
    third = lane.submit("a", lambda order: order.do(("wait", 0), dict))
    fourth = lane.submit("b", lambda order: order.do(("nothing", 0), dict))
    assert [lane.place_of(order) for order in (running, second, third, fourth)] == [None, 0, 1, 2]
    lane.cancel_all_of("a")
    assert running.outcome.result() == CANCELLED
    assert third.outcome.result() == CANCELLED
    assert second.outcome.result() is None
    assert fourth.outcome.result() is None
    lane.cancel(fourth)  # too late, which does no harm
    assert outcome(lane, "nothing") is None


def test_a_process_has_the_environment_of_its_start(
    lane: Lane, monkeypatch: pytest.MonkeyPatch
) -> None:
    homes = []
    for value in ("one", "two"):
        monkeypatch.setenv("SPACKLE_TEST", value)
        with contextlib.closing(Lane(work, 1)) as fresh:
            order = fresh.submit("", lambda order: order.do(("nothing", 0), homes.append))
            order.outcome.result()
    assert [event["home"] for event in homes] == ["one", "two"]


def test_a_closed_lane_takes_no_order() -> None:
    lane = Lane(work, 1)
    lane.close()
    assert outcome(lane, "nothing") == CANCELLED


CLOSE_WHILE_THE_FIRST_PROCESS_STARTS = """
import os, sys, time
from helpers.lane_work import work
from spackle.runtime.lanes import Lane
from spackle.runtime.task_process import import_ahead

import_ahead("helpers.endless_import")
lane = Lane(work, 1)
lane.prepare()
order = lane.submit("a", lambda order: order.do(("nothing", 0), dict))
if sys.argv[1] != "at once":
    while not os.path.exists(sys.argv[1]):
        time.sleep(0.01)
lane.close()
print(order.outcome.result().kind)
"""


@pytest.mark.skipif(not STARTS_QUICKLY, reason="processes are not forked from a server here")
@pytest.mark.parametrize("moment", ["at once", "later"])
def test_a_lane_is_closed_at_once_while_the_first_process_starts(
    tmp_path: Path, moment: str
) -> None:
    mark = tmp_path / "imports"
    argument = moment if moment == "at once" else str(mark)
    # The output ends when the last process has closed it: none is left behind.
    done = subprocess.run(
        [sys.executable, "-c", CLOSE_WHILE_THE_FIRST_PROCESS_STARTS, argument],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "SPACKLE_TEST": str(mark)},
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
    )
    assert (done.stdout, done.returncode) == ("cancelled\n", 0)


def test_a_process_that_cannot_be_started_is_tried_again_and_no_photo_is_blamed(
    lane: Lane, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusals: list[Exception] = [EOFError("unexpected EOF")]

    def start(*arguments: Any) -> TaskProcess:
        if refusals:
            raise refusals.pop()
        return TaskProcess(*arguments)

    monkeypatch.setattr("spackle.runtime.lanes.TaskProcess", start)
    assert outcome(lane, "die") == TaskFailure("died", WORKER_DIED)
    refusals += 2 * [OSError(errno.EAGAIN, "Try again later")]
    assert outcome(lane, "nothing") == TaskFailure(
        "machine", "no worker process can be started: Try again later"
    )
    assert outcome(lane, "nothing") is None


def test_a_full_disk_is_found_behind_other_errors() -> None:
    def failure_after(number: int) -> Exception:
        try:
            try:
                raise OSError(number, os.strerror(number))
            except OSError as error:
                raise InputError("cannot write") from error
        except InputError as error:
            return error

    fault = machine_fault(failure_after(errno.ENOSPC))
    assert fault is not None
    assert fault.errno == errno.ENOSPC
    assert machine_fault(failure_after(errno.ENOENT)) is None
    assert machine_fault(None) is None
