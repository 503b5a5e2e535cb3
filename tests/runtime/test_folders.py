"""Locks of folders for results, between processes and after a killed run."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
import time
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest

from spackle.runtime.errors import InputError
from spackle.runtime.folders import LOCK_NAME, atomic_files, file_lock, results_folder


def hold_lock(path: Path, pipe: Connection) -> None:
    """Lock a file until the parent sends something."""
    with file_lock(path):
        pipe.send("locked")
        pipe.recv()


def test_the_lock_of_a_killed_process_is_released(tmp_path: Path) -> None:
    lock = tmp_path / "out" / LOCK_NAME
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=hold_lock, args=(lock, theirs))
    process.start()
    assert ours.recv() == "locked"
    with (
        pytest.raises(InputError, match="out: another run is at work in this folder"),
        file_lock(lock),
    ):
        pass
    process.kill()
    process.join()
    assert lock.exists()
    with file_lock(lock):
        assert lock.exists()
    assert not lock.exists()


def test_a_lock_belongs_to_one_holder_and_any_thread_may_release_it(tmp_path: Path) -> None:
    held = file_lock(tmp_path / LOCK_NAME)
    held.__enter__()
    with pytest.raises(InputError, match="another run"), file_lock(tmp_path / LOCK_NAME):
        pass
    thread = threading.Thread(target=held.__exit__, args=(None, None, None))
    thread.start()
    thread.join()
    with file_lock(tmp_path / LOCK_NAME):
        pass


def take_turns(folder: Path, start: Event) -> None:
    """Enter a locked folder many times; each time, nobody else may have its file in it."""
    start.wait()
    for _ in range(100):
        try:
            with results_folder(folder, locked=True):
                (folder / "mine").mkdir()  # raises if another process is in the folder
                time.sleep(0.0005)
                (folder / "mine").rmdir()
        except InputError as error:
            if "another run is at work" not in str(error):
                raise


def test_processes_that_remove_the_lock_file_never_share_a_folder(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    start = spawn.Event()
    processes = [spawn.Process(target=take_turns, args=(tmp_path, start)) for _ in range(3)]
    for process in processes:
        process.start()
    start.set()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_results_is_removed_with_its_new_parents(tmp_path: Path) -> None:
    with results_folder(tmp_path / "a" / "b", locked=True):
        assert (tmp_path / "a" / "b" / LOCK_NAME).exists()
    assert not (tmp_path / "a").exists()
    with results_folder(tmp_path / "a" / "b", locked=True):
        (tmp_path / "a" / "b" / "result.txt").write_text("done")
    assert os.listdir(tmp_path / "a" / "b") == ["result.txt"]


def test_a_set_of_files_is_replaced_as_a_whole(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text("old")
    with contextlib.suppress(ZeroDivisionError), atomic_files(tmp_path, "report.json") as new:
        (new / "report.json").write_text("new")
        raise ZeroDivisionError
    assert (tmp_path / "report.json").read_text() == "old"
    with atomic_files(tmp_path, "report.json") as new:
        (new / "parts").mkdir()
        (tmp_path / "parts").mkdir()
        (new / "parts" / "1.txt").write_text("new")
        (new / "report.json").write_text("new")
    assert (tmp_path / "report.json").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts", "report.json"]
