"""A Ray cluster of two machines, of which one dies, writes the bytes of one process.

The cluster needs Ray (pip install 'spackle-nvs[ray]'), and is a slow test.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.command import run, timeless_results
from helpers.dataset_builds import write_inputs
from helpers.evaluation_data import write_boxes

import spackle
from spackle.cli.options import use_gpu_alone
from spackle.results.results_file import RESULTS_NAME
from spackle.runtime.errors import InputError
from spackle.runtime.ray_workers import RayWorker, Surroundings
from spackle.runtime.worker_options import WorkerOptions
from spackle.runtime.workers import parallel_map

PHOTO_COUNT = 5
WAIT_SECONDS = 240  # for a first result, on a busy machine


class TwoMachines:
    """A cluster of two machines, each with room for one worker, which are processes here."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        # The dashboard would be ten processes more.
        head = {"num_cpus": 1, "include_dashboard": False}
        self.cluster: Any = Cluster(initialize_head=True, head_node_args=head)
        self.other: Any = self.cluster.add_node(num_cpus=1)
        self.address: str = self.cluster.address

    def kill_other(self) -> None:
        """End all processes of the second machine, as if its power failed."""
        for processes in self.other.all_processes.values():
            for process in processes:
                process.process.kill()


@pytest.fixture
def machines() -> Iterator[TwoMachines]:
    pytest.importorskip("ray")
    machines = TwoMachines()
    yield machines
    machines.cluster.shutdown()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos with depth, and stereo pairs."""
    place = write_inputs(tmp_path_factory.mktemp("inputs"), PHOTO_COUNT)
    for number in range(3):
        write_boxes(place / "pairs" / f"scene{number}", number)
    return place


def predict_words(place: Path, out: Path) -> Sequence[object]:
    return ("predict", place / "photos", "--depth", place / "depth", "-o", out, *FEW_FRAMES)


FEW_FRAMES = ("--frames", 3, "--format", "gif", "--threads", 1)  # x264 may encode otherwise


def tar_words(place: Path, out: Path) -> Sequence[object]:
    given = (place / "photos", "--depth", place / "depth", "-o", out)
    return ("predict", *given, "--no-render", "--tar", 2, "--threads", 1)


def dataset_words(place: Path, out: Path) -> Sequence[object]:
    options = ("--base", "rgbd", "--views", 4, "--shard-size", 2, "--threads", 1)
    return ("dataset", "build", place / "photos", "--depth", place / "depth", "-o", out, *options)


def evaluate_words(place: Path, out: Path) -> Sequence[object]:
    options = ("--dataset", "middlebury", "--base", "rgbd", "--methods", "base,paper-initial")
    return (
        "evaluate",
        place / "pairs",
        "-o",
        out,
        *options,
        "--metrics",
        "none",
        "--disparity",
        "0.3",
        "--threads",
        1,
    )


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a command's results, by name.

    Reports are left out, because they have times in them, and of results.jsonl the times. The
    hidden file that a worker was writing when it died, and which the next run removes, is left out,
    too.
    """
    found = {}
    for file in sorted(folder.rglob("[!.]*")):
        name = file.relative_to(folder).as_posix()
        if not file.is_file() or file.name in ("report.json", "config.json"):
            continue
        content = file.read_bytes()
        if name == RESULTS_NAME:
            content = json.dumps(timeless_results(folder)).encode()
        found[name] = hashlib.sha256(content).hexdigest()
    return found


def when_first(folder: Path, pattern: str, act: Callable[[], object]) -> threading.Thread:
    """A started thread that waits for a first result in a folder, and then calls `act`."""

    def wait() -> None:
        deadline = time.monotonic() + WAIT_SECONDS
        while not list(folder.glob(pattern)) and time.monotonic() < deadline:
            time.sleep(0.005)
        act()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


COMMANDS = [
    pytest.param(predict_words, "*/report.json", "*/scene.ply", id="predict"),
    pytest.param(tar_words, "results-*.tar", "results-*.tar", id="tars"),
    pytest.param(dataset_words, "parts/*.tar", "shard-*.tar", id="dataset"),
    pytest.param(evaluate_words, "images/[0-9]*.json", "images/[0-9]*.json", id="evaluate"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "first_result", "results"), COMMANDS)
def test_a_machine_that_dies_changes_no_byte_and_costs_no_result(
    machines: TwoMachines,
    place: Path,
    tmp_path: Path,
    words: Callable[[Path, Path], Sequence[object]],
    first_result: str,
    results: str,
) -> None:
    alone = tmp_path / "alone"
    done = run(*words(place, alone))
    assert done.code == 0, done.err

    out = tmp_path / "out"
    times: dict[Path, int] = {}

    def kill() -> None:
        machines.kill_other()
        times.update({path: path.stat().st_mtime_ns for path in out.glob(results)})

    killer = when_first(out, first_result, kill)
    done = run(*words(place, out), "--ray", machines.address)
    killer.join()
    assert done.code == 0, done.err
    assert digests(out) == digests(alone)
    # What was done before the machine died was not done again.
    assert all(path.stat().st_mtime_ns == written for path, written in times.items())
    assert not (out / ".ray").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("words", "first_result", "results"), COMMANDS)
def test_a_killed_command_goes_on(
    machines: TwoMachines,
    place: Path,
    tmp_path: Path,
    words: Callable[[Path, Path], Sequence[object]],
    first_result: str,
    results: str,
) -> None:
    alone = tmp_path / "alone"
    assert run(*words(place, alone)).code == 0

    out = tmp_path / "out"
    command = [*words(place, out), "--ray", machines.address]
    process = subprocess.Popen([sys.executable, "-m", "spackle", *map(str, command)])
    killer = when_first(out, first_result, process.kill)
    assert process.wait() == -signal.SIGKILL
    killer.join()
    done = run(*command)
    assert done.code == 0, done.err
    assert digests(out) == digests(alone)


def test_without_ray_the_option_says_what_to_install(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    done = run(*predict_words(place, tmp_path / "out"), "--ray", "local")
    assert done.code == 2
    assert done.lines[-1] == "error: --ray needs Ray: pip install 'spackle-nvs[ray]'"


@pytest.mark.parametrize(
    ("address", "says", "has_dashboard"),
    [
        # A dashboard would take jobs from everybody who can reach its port.
        ("local", "no cluster starts here .not here.: try again", False),
        ("10.0.0.1:6379", "no cluster answers .not here.: start one", None),
    ],
)
def test_a_cluster_that_does_not_start_or_answer_is_a_line(
    monkeypatch: pytest.MonkeyPatch, address: str, says: str, has_dashboard: bool | None
) -> None:
    words: dict[str, object] = {}

    def init(**given: object) -> None:
        words.update(given)
        raise OSError("not here")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    workers = WorkerOptions(count=1, threads=1, gpu=False, ray=address)
    mapped = parallel_map(RayWorker, [1], lambda: False, workers, Path())
    with pytest.raises(InputError, match=says), mapped:
        pass
    assert words.get("include_dashboard") is has_dashboard


@pytest.mark.parametrize(
    ("visible", "device", "expected"),
    [(None, "cuda:1", "1"), ("4,6", "cuda:1", "6"), ("4", "cuda:1", "")],
)
def test_a_gpu_with_a_number_is_the_only_one_that_is_seen(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, device: str, expected: str
) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert use_gpu_alone(device) == "cuda"
    assert os.environ["CUDA_VISIBLE_DEVICES"] == expected


def test_a_worker_that_sees_another_folder_or_version_says_so(tmp_path: Path) -> None:
    mark = tmp_path / ".ray"
    mark.write_text("of another run")
    here = Surroundings(spackle.__version__, str(tmp_path), mark, b"of this run", {})
    for surroundings, reason in (
        (here._replace(version="0.0.1"), "runs Spackle .* and the command 0.0.1"),
        (here, "does not see .*: all machines need the same `output`"),
    ):
        with pytest.raises(InputError, match=reason):
            RayWorker(surroundings, b"", 1).make(b"")
