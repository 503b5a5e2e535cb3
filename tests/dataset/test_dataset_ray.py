"""A dataset built by workers on a Ray cluster: the same bytes, whoever dies, and a line where that cannot be."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command import Run, names_in
from dataset_builds import build, content, dying_build, is_alive, refused

from spackle.bases.open import BaseSettings
from spackle.dataset import ray as on_ray
from spackle.dataset.maker import IN_HAND, Job, Made
from spackle.dataset.options import DatasetOptions
from spackle.dataset.photos import PhotoFile
from spackle.dataset.ray import RemoteMaker
from spackle.dataset.views import ViewChoices

os.environ.setdefault("RAY_AUTH_MODE", "token")  # before it is loaded: a cluster of newer versions wants one
ray = pytest.importorskip("ray")

CLUSTER = """
import ray, sys
context = ray.init("local", num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False, logging_level="error")
print(context.address_info["address"], flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a cluster with room for two workers; it ends with the process that holds it."""
    with subprocess.Popen([sys.executable, "-c", CLUSTER], stdin=-1, stdout=-1, stderr=-3, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.communicate()


def dying(at: int, times: int, notes: Path, where: str = "make") -> type[RemoteMaker]:
    """Workers of which the first few are killed when they have made this photo, or as they begin."""

    def turn() -> None:
        turns = len(list(notes.iterdir()))
        if turns < times:
            (notes / str(turns)).touch()
            os.kill(os.getpid(), signal.SIGKILL)

    class Dying(RemoteMaker):
        def begin(self, expected: Any) -> None:
            if where == "begin":
                turn()
            super().begin(expected)

        def make(self, job: Job, seen: Sequence[str]) -> tuple[Made, bytes | None]:
            answer = super().make(job, seen)
            if where == "make" and job[0] == at:
                turn()
            return answer

    notes.mkdir()
    return Dying


def on(address: str, place: Path, output: Path, *more: object) -> Run:
    return build(place, output, "--ray", address, "--workers", 2, *more)


# The same bytes -----------------------------------------------------------------------------------


def test_a_local_cluster_makes_the_same_bytes_and_ends(place: Path, whole: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    done = on("local", place, tmp_path / "out")
    assert done.code == 0, done.err
    assert done.out == ""
    assert len(done.lines) == 2, done.err  # nothing of Ray's own
    assert content(tmp_path / "out") == content(whole)
    assert not ray.is_initialized()
    assert signal.getsignal(signal.SIGTERM) is before


def test_photos_of_a_killed_worker_are_made_again_by_another(
    place: Path, whole: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_ray, "RemoteMaker", dying(2, 1, tmp_path / "notes"))
    done = on(address, place, tmp_path / "out")
    assert (done.code, done.out) == (0, ""), done.err
    assert len(done.lines) == 3
    assert f"{place}/photos/3.png: at this photo a worker died, and another takes its place" in done.lines[0]
    assert names_in(tmp_path / "notes") == {"0"}  # one was killed
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow
def test_a_photo_that_kills_every_worker_ends_the_build_which_goes_on_later(
    place: Path, whole: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(on_ray, "RemoteMaker", dying(2, 99, tmp_path / "notes"))
        done = on(address, place, tmp_path / "out")
    assert (done.code, done.out, len(done.lines)) == (2, "", 4)
    assert f"{place}/photos/3.png: at this photo a worker died for the 4th time" in done.lines[-1]
    assert names_in(tmp_path / "notes") == {"0", "1", "2", "3"}
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow
def test_workers_and_their_cluster_end_with_a_killed_build(place: Path, whole: Path, tmp_path: Path) -> None:
    note = tmp_path / "processes"
    patch = f"""
def dying(*arguments):
    with open({str(note)!r}, "w") as file:
        subprocess.run(["ps", "-eo", "pid=,ppid=,args="], stdout=file)
    die()
build._Build._note = dying"""
    more = ("--ray", "local", "--workers", 2)
    process = dying_build(tmp_path / "script.py", patch, place, tmp_path / "out", *more)
    assert process.wait() == -signal.SIGKILL
    # Ray's own agents take a minute.
    pids = [pid for pid, args in below(process.pid, note.read_text()) if "agent" not in args.lower()]
    assert len(pids) >= 4  # two workers, and at least two that Ray consists of
    deadline = time.monotonic() + 30
    while any(is_alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "a process of the cluster goes on"
        time.sleep(0.1)
    assert build(place, tmp_path / "out").code == 0
    assert content(tmp_path / "out") == content(whole)


def below(top: int, listing: str) -> list[tuple[int, str]]:
    """Number and command of every process that a process has started, or one of those, by what ps says."""
    rows = [line.split(None, 2) for line in listing.splitlines()]
    own = [(int(pid), args) for pid, parent, args in rows if int(parent) == top and not args.startswith("ps ")]
    return own + [row for pid, _ in own for row in below(pid, listing)]


# What cannot be -----------------------------------------------------------------------------------


def test_an_address_where_nobody_answers_is_a_line(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_ray, "ANSWER_S", 1.0)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with socket.socket() as nobody:  # takes the port, and no calls
        nobody.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        done = on(address, place, tmp_path / "out")
    refused(done, f"--ray {address}: no cluster: no answer within 1 seconds")
    monkeypatch.setattr(on_ray, "ANSWER_S", 60.0)
    done = on("nowhere", place, tmp_path / "out")
    refused(done, "--ray nowhere: no cluster: ValueError: ")
    assert not (tmp_path / "out").exists()


def test_a_cluster_without_room_is_a_line(place: Path, address: str, tmp_path: Path) -> None:
    done = on(address, place, tmp_path / "out", "--workers", 3)
    refused(done, f"--ray {address}: room for 2 of 3 workers")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "instead", "line"),
    [
        ("what_is_seen", ["another", "photo"], "0.png: node {node} does not find this photo or its depth map"),
        ("configuration", {"spackle": "0.0"}, 'would make another dataset (base: null -> {{"name'),
        ("RemoteMaker", "begin", "as it started a worker died for the 4th time"),
    ],
)
def test_a_node_that_is_not_like_the_others_is_a_line(
    place: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, instead: Any, line: str
) -> None:
    if name == "RemoteMaker":
        monkeypatch.setattr(on_ray, name, dying(0, 99, tmp_path / "notes", instead))
    else:
        monkeypatch.setattr(on_ray, name, lambda *arguments: instead)
    done = on(address, place, tmp_path / "out")
    assert (done.code, len(done.lines)) == (2, 1 if name != "RemoteMaker" else 4)
    assert line.format(node=socket.gethostname()) in done.lines[-1]
    assert names_in(tmp_path / "out" / "parts") == set()


def test_a_worker_takes_a_gpu_only_where_a_network_uses_one(tmp_path: Path) -> None:
    def options(base: str, device: str = "auto", inpainter: str = "geometry") -> DatasetOptions:
        return DatasetOptions(BaseSettings(base, device=device), ViewChoices(), inpainter=inpainter)

    with_one = [{"Alive": True, "Resources": {"CPU": 4.0}}, {"Alive": True, "Resources": {"CPU": 4.0, "GPU": 1.0}}]
    assert on_ray.gpus_of(options("sharp"), with_one) == 1
    assert on_ray.gpus_of(options("rgbd", inpainter="propainter"), with_one) == 1
    assert on_ray.gpus_of(options("rgbd"), with_one) == 0
    assert on_ray.gpus_of(options("sharp", "cpu"), with_one) == 0
    assert on_ray.gpus_of(options("sharp"), with_one[:1]) == 0
    assert on_ray.gpus_of(options("sharp"), [with_one[0], {**with_one[1], "Alive": False}]) == 0


# Back-pressure ------------------------------------------------------------------------------------


def noting(counts: list[int]) -> SimpleNamespace:
    """Stands in for the package: answers the oldest call first, and counts at each call how many are open."""
    calls: list[Callable[[], object]] = []

    def ask(answer: object) -> Callable[[], object]:
        calls.append(lambda: answer)
        counts.append(len(calls))
        return calls[-1]

    def get(call: Callable[[], object]) -> object:
        calls.remove(call)
        return call()

    actor = SimpleNamespace(
        begin=SimpleNamespace(remote=lambda expected: ask(None)),
        make=SimpleNamespace(remote=lambda job, seen: ask((Made(job[0], {}, "none"), None))),
    )
    return SimpleNamespace(
        remote=lambda **resources: lambda kind: SimpleNamespace(remote=lambda *arguments: actor),
        wait=lambda calls, timeout: (calls[:1], calls[1:]),
        get=get,
        kill=lambda actor: None,
        nodes=list,
        exceptions=ray.exceptions,
    )


def test_workers_have_few_photos_in_hand(tmp_path: Path) -> None:
    options = DatasetOptions(BaseSettings("rgbd", tmp_path), ViewChoices(), workers=3, ray="local")
    jobs = [(number, PhotoFile(tmp_path / f"{number}.png", f"{number}.png", "")) for number in range(50)]
    counts: list[int] = []
    crew = on_ray.WorkerPool(noting(counts), options, tmp_path, jobs, print)
    assert sorted(made.index for made in crew.results()) == list(range(50))
    assert max(counts) == 3 * IN_HAND
