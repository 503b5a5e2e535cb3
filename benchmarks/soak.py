"""Soak test of the server: many jobs, hostile or cancelled ones, killed workers, a full disk.

    python benchmarks/soak.py [--jobs 300] [--minutes 10] [-o results.json]

The server is a process of its own, on a small disk in memory (tmpfs) where this user may mount one;
otherwise the disk is never full, and the result says so. Its workers only pretend to complete
photos: what is tested is the server. Uploads are decoded for real.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import http.client
import io
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from spackle.cli.script_command import run_script
from spackle.runtime.files import check_writable

TOKEN = "soak-test-token-0123"
SCENES = "/api/v1/scenes"
BOUNDARY = "7d1"
DISK_BYTES = 400_000_000  # above what the server wants to be free, so that it is ready
SCENE_BYTES = 200_000
WORK_S = 0.15  # seconds that a pretended scene takes
HOSTILE_EVERY = 10
CANCELLED_EVERY = 20
KILLED_EVERY = 20
PROBE_S = 0.1  # seconds between two requests of /healthz
MEMORY_PROBE_S = 2.0
MAX_WAITING = 8  # jobs that are sent and not done yet
DISK_FULL_S = 5.0
LOOP_FILE = "loop.json"  # beside the folder of scenes: what the server says at its end


# --- The server


def pretend(task: Any, send_event: Any) -> None:
    """Write a scene, or a file of it, of `SCENE_BYTES`; the function of a worker process."""
    from spackle.runtime.files import write_atomic

    if isinstance(task, str):
        return
    job, file = task
    send_event({"stage": "base", "done": 1, "total": 2})
    time.sleep(WORK_S)
    if file is None:
        write_atomic(job.results / "page.json", b"{}")
        write_atomic(job.results / "base.splats", os.urandom(SCENE_BYTES))
        # How often the work of this job came to its end.
        with (job.folder / "ends").open("a") as ends:
            ends.write("x")
    else:
        write_atomic(job.results / file, os.urandom(SCENE_BYTES))


def serve(folder: Path, port: int) -> None:
    """Run the server until it is stopped."""
    from spackle.web import jobs
    from spackle.web.app import create_app
    from spackle.web.guard import Access
    from spackle.web.local_server import answer_requests

    jobs.RETRY_S = 2.0  # so that the soak need not wait for half a minute
    loop_steps = time_loop_steps()
    collections = time_collections()
    # The server raises the signal that has ended it once more; the report is still to be written.
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    access = Access.for_listener("127.0.0.1", "127.0.0.1", TOKEN)
    app = create_app(folder, pretend, workers=2, access=access)
    with socket.create_server(("127.0.0.1", port)) as listener:
        answer_requests(app, listener)
    report = {
        "steps of the event loop, ms of the processor": summary(loop_steps),
        "collections of garbage, ms of the processor": summary(collections),
    }
    (folder.parent / LOOP_FILE).write_text(json.dumps(report))


def time_loop_steps() -> list[float]:
    """A list to which the milliseconds of each step of this process's event loop will be added.

    During a step nobody is answered. Milliseconds are those of the processor, whatever else runs
    on the machine.
    """
    milliseconds: list[float] = []
    run = asyncio.Handle._run

    def run_timed(handle: Any) -> None:
        start = time.thread_time()
        run(handle)
        milliseconds.append(1000 * (time.thread_time() - start))

    asyncio.Handle._run = run_timed  # type: ignore[method-assign]
    return milliseconds


def time_collections() -> list[float]:
    """A list to which the milliseconds of each collection of garbage will be added.

    No thread of the process does anything meanwhile. Milliseconds are those of the processor.
    """
    milliseconds: list[float] = []
    starts: list[float] = []

    def note(phase: str, facts: object) -> None:
        if phase == "start":
            starts.append(time.thread_time())
        elif starts:
            milliseconds.append(1000 * (time.thread_time() - starts.pop()))

    gc.callbacks.append(note)
    return milliseconds


# --- Inputs


def photo(seed: int) -> bytes:
    """A small JPEG, another one for each seed."""
    picture = Image.effect_noise((160, 120), 40).convert("RGB")
    picture.putpixel((0, 0), (seed % 256, seed // 256 % 256, 0))
    picture.save(file := io.BytesIO(), "JPEG")
    return file.getvalue()


def endless_jpeg() -> bytes:
    """A progressive JPEG of 4 megapixels with 20,000 scans of a few bytes."""
    Image.new("L", (2048, 2048), 90).save(file := io.BytesIO(), "JPEG", progressive=True)
    content = file.getvalue()
    last_scan = content.rindex(b"\xff\xda")
    return content[:last_scan] + 20_000 * content[last_scan:-2] + content[-2:]


def hostile_upload(number: int) -> tuple[bytes, str]:
    """The body and the content type of an upload that must be refused."""
    whole = photo(number)
    kinds = [
        (form(whole[: len(whole) // 2]), "multipart/form-data"),
        (form(b"<html>"), "multipart/form-data"),
        (form(os.urandom(20_000)), "multipart/form-data"),
        (form(whole, options='{"frames": -1}'), "multipart/form-data"),
        (form(whole, options=50_000 * "["), "multipart/form-data"),
        (form(whole, options=50_000 * "a"), "multipart/form-data; charset=punycode"),
        (b"photo=1&" * 50_000, "application/x-www-form-urlencoded"),
        (form(png_bomb()), "multipart/form-data"),
    ]
    # One in so many is the slowest kind, because it takes its whole limit of time.
    if number % (8 * HOSTILE_EVERY) == 0:
        return form(endless_jpeg()), "multipart/form-data"
    return kinds[number // HOSTILE_EVERY % len(kinds)]


def png_bomb() -> bytes:
    """A PNG of a few kilobytes with 64 megapixels."""
    Image.new("1", (8000, 8000)).save(file := io.BytesIO(), "PNG")
    return file.getvalue()


def form(content: bytes, options: str = "{}") -> bytes:
    """A multipart body with a photo."""
    head = f"--{BOUNDARY}\r\nContent-Disposition: form-data; name="
    return b"".join(
        [
            f'{head}"options"\r\n\r\n{options}\r\n'.encode(),
            f'{head}"photo"; filename="photo.jpg"\r\n\r\n'.encode(),
            content,
            f"\r\n--{BOUNDARY}--\r\n".encode(),
        ]
    )


# --- The client


class Client:
    """Sends requests to the server, each by a connection of its own."""

    def __init__(self, port: int) -> None:
        self.port = port

    def ask(
        self, path: str, method: str = "GET", body: bytes | None = None, kind: str = ""
    ) -> tuple[int, Any]:
        """Status and content of the answer."""
        headers = {"Authorization": f"Bearer {TOKEN}"}
        if body is not None:
            separator = "; boundary=" if kind.startswith("multipart") else "; x="
            headers["Content-Type"] = f"{kind}{separator}{BOUNDARY}"
        with contextlib.closing(
            http.client.HTTPConnection("127.0.0.1", self.port, timeout=180)
        ) as connection:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            content = answer.read()
            is_json = answer.headers.get("content-type", "").startswith("application/json")
            return answer.status, json.loads(content) if is_json and content else content


def watch(port: int, pid: int) -> None:
    """Measure the server until the standard input ends, and print the measurements as JSON.

    A process of its own does this: in that of the client, it would wait for other threads.
    """
    client = Client(port)
    measured: dict[str, list[float]] = {"health_ms": [], "late_ms": [], "megabytes": []}
    next_memory = 0.0
    asleep = time.perf_counter()
    while not select.select([sys.stdin], [], [], PROBE_S)[0]:
        start = time.perf_counter()
        # How much later than asked this process wakes up: what the machine itself adds.
        measured["late_ms"].append(1000 * (start - asleep - PROBE_S))
        status, _ = client.ask("/healthz")
        assert status == 200
        measured["health_ms"].append(1000 * (time.perf_counter() - start))
        if time.monotonic() > next_memory:
            next_memory = time.monotonic() + MEMORY_PROBE_S
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            measured["megabytes"].append(pages * os.sysconf("SC_PAGESIZE") / 1e6)
        asleep = time.perf_counter()
    print(json.dumps(measured))


def children_of(pid: int) -> list[int]:
    """The processes below a process."""
    below: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            for child in map(int, (task / "children").read_text().split()):
                below += [child, *children_of(child)]
    return below


def kill_a_worker(server: int) -> bool:
    """Kill a worker process of the server: one that was forked from the process that forks."""
    for child in children_of(server):
        grandchildren = children_of(child) if Path(f"/proc/{child}").exists() else []
        if grandchildren:
            with contextlib.suppress(ProcessLookupError):
                os.kill(random.choice(grandchildren), signal.SIGKILL)
                return True
    return False


@contextlib.contextmanager
def small_disk() -> Iterator[tuple[Path, bool]]:
    """A folder, on a disk of its own of `DISK_BYTES` if possible, and whether it is."""
    with tempfile.TemporaryDirectory(prefix="spackle-soak-") as name:
        size = f"size={DISK_BYTES}"
        command = ["mount", "-t", "tmpfs", "-o", size, "tmpfs", name]
        is_mounted = subprocess.run(command, capture_output=True).returncode == 0
        try:
            yield Path(name), is_mounted
        finally:
            if is_mounted:
                subprocess.run(["umount", name], check=True)


@contextlib.contextmanager
def running_server(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], Client]]:
    """The server, once it is ready."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    command = [sys.executable, __file__, "--serve", str(folder), "--port", str(port)]
    with subprocess.Popen(command) as process:
        client = Client(port)
        try:
            while True:
                with contextlib.suppress(OSError):
                    if client.ask("/readyz")[0] == 200:
                        break
                assert process.poll() is None, "the server has ended"
                time.sleep(0.2)
            yield process, client
        finally:
            process.terminate()
            process.wait(60)


def soak(job_count: int, minutes: float) -> dict[str, Any]:
    """Send the jobs, and return what became of them."""
    random.seed(0)
    answers: Counter[str] = Counter()
    refused_bombs: list[float] = []
    states: dict[str, dict[str, Any]] = {}  # of the good jobs that were accepted, by id
    cancelled: list[str] = []
    kills = 0
    with small_disk() as (disk, has_own_disk), running_server(disk / "scenes") as (server, client):
        # What the first job loads is no leak.
        client.ask(SCENES, "POST", form(photo(0)), "multipart/form-data")
        numbers = ["--watch", str(server.pid), "--port", str(client.port)]
        watcher = subprocess.Popen(
            [sys.executable, __file__, *numbers], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        start = time.monotonic()
        sent = 0
        filler: threading.Thread | None = None
        while sent < job_count and time.monotonic() - start < 60 * minutes:
            sent += 1
            if sent % HOSTILE_EVERY == 0:
                body, kind = hostile_upload(sent)
                begin = time.monotonic()
                status, _ = client.ask(SCENES, "POST", body, kind)
                refused_bombs.append(time.monotonic() - begin)
                answers[f"hostile: {status}"] += 1
                continue
            status = 507
            state: dict[str, Any] = {}
            while status in (429, 507):  # the client tries again, as it is told
                body = form(photo(sent), '{"files": []}')
                status, state = client.ask(SCENES, "POST", body, "multipart/form-data")
                answers[f"good: {status}"] += 1
                if status != 202:
                    time.sleep(0.5)
            if sent % CANCELLED_EVERY == 7:
                assert client.ask(f"{SCENES}/{state['id']}", "DELETE")[0] == 204
                cancelled.append(state["id"])
            else:
                states[state["id"]] = state
            if sent % KILLED_EVERY == 3:
                kills += kill_a_worker(server.pid)
            if sent % 7 == 0:  # a file of a scene, whose client leaves at once
                with contextlib.suppress(OSError):
                    impatient = socket.create_connection(("127.0.0.1", client.port))
                    path = f"{SCENES}/{state['id']}/files/orbit.mp4"
                    lines = f"GET {path} HTTP/1.1\r\nHost: localhost\r\n"
                    impatient.send(f"{lines}Authorization: Bearer {TOKEN}\r\n\r\n".encode())
                    impatient.close()
            if has_own_disk and filler is None and sent > job_count // 2:
                filler = threading.Thread(target=fill_disk, args=(disk,))
                filler.start()
            wait_for_room(client, states)
        if filler is not None:
            filler.join()
        wait_for_room(client, states, 0)
        seconds = time.monotonic() - start
        measured = json.loads(watcher.communicate()[0])
        time.sleep(6)  # what nobody waits for any more is given up by now
        folders = {path.name for path in (disk / "scenes").iterdir() if path.is_dir()}
        ends = {id: (disk / "scenes" / id / "ends").read_text() for id in states}
        temporary = list((disk / "scenes").rglob(".*.*"))
        workers = len(children_of(server.pid))
        # The server says at its end what its event loop has done.
        server.terminate()
        server.wait(60)
        loop_report = json.loads((disk / LOOP_FILE).read_text())
    megabytes = measured["megabytes"]
    third = max(1, len(megabytes) // 3)
    return {
        "jobs sent": sent,
        "minutes": round(seconds / 60, 1),
        "answers": dict(answers),
        "good ones accepted": len(states),
        "of those": dict(Counter(state["state"] for state in states.values())),
        "errors": [state["error"] for state in states.values() if state["error"]],
        "done more than once": sum(len(each) > 1 for each in ends.values()),
        "cancelled": len(cancelled),
        "cancelled ones that are left": len(folders & set(cancelled)),
        # The first job, which warmed the server up, is neither.
        "folders beyond the jobs": len(folders - set(states)) - 1,
        "temporary files left": len(temporary),
        "workers killed": kills,
        "disk full once": has_own_disk,
        "processes at the end": workers,
        "seconds of the slowest refusal": round(max(refused_bombs, default=0), 1),
        "healthz, ms": summary(measured["health_ms"]),
        "who asks for it wakes up late by, ms": summary(measured["late_ms"]),
        **loop_report,
        "server, MB": {
            "first third": round(sum(megabytes[:third]) / third),
            "last third": round(sum(megabytes[-third:]) / third),
            "most": round(max(megabytes)),
        },
    }


def summary(values: list[float]) -> dict[str, float]:
    """The middle and the end of a list of numbers."""
    values = sorted(values)
    return {
        "median": round(values[len(values) // 2], 1),
        "p99": round(values[int(0.99 * (len(values) - 1))], 1),
        "longest": round(values[-1], 1),
        "count": len(values),
    }


def fill_disk(disk: Path) -> None:
    """Fill the disk for a while."""
    ballast = disk / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(100_000))
    time.sleep(DISK_FULL_S)
    ballast.unlink()


def wait_for_room(
    client: Client, states: dict[str, dict[str, Any]], most: int = MAX_WAITING
) -> None:
    """Wait until no more than `most` of the jobs are unfinished; their states are renewed."""
    while True:
        unfinished = [id for id, state in states.items() if state["ended"] is None]
        if len(unfinished) <= most:
            return
        for id in unfinished:
            status, states[id] = client.ask(f"{SCENES}/{id}")
            assert status == 200, status
        time.sleep(0.05)


def main() -> None:
    """Run the soak test, or the server that it tests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--watch", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.serve is not None:
        serve(given.serve, given.port)
        return
    if given.watch is not None:
        watch(given.port, given.watch)
        return
    if given.output is not None:
        check_writable(given.output)
    text = json.dumps(soak(given.jobs, given.minutes), indent=1)
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    sys.exit(run_script(main))
