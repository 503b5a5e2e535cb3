"""Load test of `spackle serve`: photos after the server is killed, response times, and the cost of
clients.

    python benchmarks/serve.py [--side 480] [--photos 20] [--workers 2] [-o results.json]

Photos are completed by the real pipeline with `lite`; the server is a separate process on this
machine.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import os
import random
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from importlib import resources
from pathlib import Path
from typing import Any

from PIL import Image

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_writable

TOKEN, SCENES, BOUNDARY = "benchmark", "/api/v1/scenes", "7d1"


def photo(side: int) -> bytes:
    """One of the page's example photos, `side` pixels on its long side."""
    with (
        resources.files("spackle.web").joinpath("page", "coffee.jpg").open("rb") as file,
        Image.open(file) as image,
    ):
        image.thumbnail((side, side))
        image.save(content := io.BytesIO(), "JPEG", quality=92)
    return content.getvalue()


def upload(content: bytes) -> bytes:
    """The HTTP request that uploads a photo."""
    options = json.dumps({"files": ["scene.spz"]})
    body = (
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="options"\r\n\r\n'
        f"{options}\r\n--{BOUNDARY}\r\n"
        'Content-Disposition: form-data; name="photo"; filename="photo.jpg"\r\n\r\n'
    ).encode()
    body += content + f"\r\n--{BOUNDARY}--\r\n".encode()
    kind = (
        f"Content-Type: multipart/form-data; boundary={BOUNDARY}\r\nContent-Length: {len(body)}\r\n"
    )
    return head("POST", SCENES, kind) + body


def head(method: str, path: str, more: str = "") -> bytes:
    fixed = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n"
    return f"{fixed}{more}\r\n".encode()


class Client:
    """A client with a persistent connection."""

    def __init__(self, port: int) -> None:
        self.port = port

    async def __aenter__(self) -> Client:
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self.port)
        return self

    async def __aexit__(self, *error: object) -> None:
        self._writer.close()

    async def ask(self, request: bytes) -> tuple[int, Any]:
        self._writer.write(request)
        await self._writer.drain()
        answer = (await self._reader.readuntil(b"\r\n\r\n")).decode().lower()
        length = re.search(r"content-length: (\d+)", answer)
        body = await self._reader.readexactly(int(length[1]) if length else 0)
        return int(answer.split()[1]), json.loads(body or b"null")


class Server:
    """`spackle serve` in a child process."""

    def __init__(self, folder: Path, workers: int, waiting: int) -> None:
        words = ["serve", "--port", "0", "--token", TOKEN, "--base", "lite", "-o", str(folder)]
        words += ["--workers", str(workers), "--waiting", str(waiting)]
        said = folder.with_suffix(".log")
        with said.open("w") as log:
            self.process = subprocess.Popen([sys.executable, "-m", "spackle", *words], stderr=log)
        while (found := re.search(r"http://127\.0\.0\.1:(\d+)", said.read_text())) is None:
            assert self.process.poll() is None, said.read_text()
            time.sleep(0.1)
        self.port = int(found[1])

    def facts(self) -> dict[str, float]:
        """Memory, threads and open files of the server process, without its workers."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        memory, threads = (
            int(re.search(rf"{key}:\s+(\d+)", status)[1]) for key in ("VmRSS", "Threads")
        )  # type: ignore[index]
        return {
            "MB": round(memory / 1024),
            "threads": threads,
            "files": len(os.listdir(f"/proc/{self.process.pid}/fd")),
        }

    def busy(self) -> float:
        """CPU seconds so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")

    def end(self, number: int) -> None:
        self.process.send_signal(number)
        self.process.wait(30)


async def states(port: int, ids: list[str]) -> dict[str, Any]:
    async with Client(port) as client:
        return {id: (await client.ask(head("GET", f"{SCENES}/{id}")))[1] for id in ids}


async def latencies(port: int, id: str, seconds: float, pause: float = 0.02) -> list[float]:
    """Request the status again and again; returns the milliseconds of each answer."""
    found: list[float] = []
    async with Client(port) as client:
        end = time.perf_counter() + seconds
        while (start := time.perf_counter()) < end:
            await client.ask(head("GET", f"{SCENES}/{id}"))
            found.append(1000 * (time.perf_counter() - start))
            await asyncio.sleep(pause)
    return found


def summary(found: list[float]) -> dict[str, float]:
    found.sort()
    places = {"median": 0.5, "p95": 0.95, "p99": 0.99}
    return {
        **{name: round(found[int(at * (len(found) - 1))], 1) for name, at in places.items()},
        "asked": len(found),
    }


async def post(port: int, request: bytes) -> tuple[int, Any]:
    async with Client(port) as client:
        return await client.ask(request)


def killed_in_between(folder: Path, content: bytes, count: int, workers: int) -> dict[str, Any]:
    """Upload all photos at once; kill and restart the server when a quarter is done, and when half
    is.
    """
    server = Server(folder, workers, count)
    before = server.facts()
    start = time.monotonic()
    answers = asyncio.run(_together(server.port, upload(content), count))
    ids = [state["id"] for code, state in answers if code == 202]
    busy = asyncio.run(latencies(server.port, ids[-1], 20))
    done_before: dict[str, float] = {}
    for part in (4, 2):
        while len(done_before) < count // part:
            time.sleep(0.2)
            found = asyncio.run(states(server.port, ids))
            done_before |= {id: state["ended"] for id, state in found.items() if state["ended"]}
        time.sleep(random.uniform(0, 3))
        server.end(signal.SIGKILL)
        server = Server(folder, workers, count)
    while True:
        found = asyncio.run(states(server.port, ids))
        if all(state["ended"] for state in found.values()):
            break
        time.sleep(0.5)
    seconds, after = time.monotonic() - start, server.facts()
    server.end(signal.SIGTERM)
    folders = [path.name for path in folder.iterdir() if path.is_dir()]
    whole = [id for id in ids if (folder / id / "results" / "scene.spz").is_file()]
    return {
        "posted": count,
        "accepted": len(ids),
        "states": Counter(state["state"] for state in found.values()),
        "errors": Counter(state["error"] for state in found.values() if state["error"]),
        "scenes on the disk": len(whole),
        "lost": len(set(ids) - set(found)) + len(set(ids) - set(folders)),
        "folders beyond the jobs": len(set(folders) - set(ids)),
        "done before a kill": len(done_before),
        "of those done again": sum(found[id]["ended"] != when for id, when in done_before.items()),
        "seconds": round(seconds, 1),
        "status under load, ms": summary(busy),
        "server at first": before,
        "server at the end": after,
    }


async def _together(port: int, request: bytes, count: int) -> list[tuple[int, Any]]:
    return await asyncio.gather(*(post(port, request) for _ in range(count)))


async def rate(port: int, id: str, connections: int, seconds: float) -> float:
    """Status answers per second, if each connection asks again as soon as it has an answer."""
    count, end = 0, time.perf_counter() + seconds

    async def one() -> None:
        nonlocal count
        async with Client(port) as client:
            while time.perf_counter() < end:
                await client.ask(head("GET", f"{SCENES}/{id}"))
                count += 1

    await asyncio.gather(*(one() for _ in range(connections)))
    return count / seconds


def crowd(folder: Path, content: bytes) -> dict[str, Any]:
    """Measure a hundred simultaneous uploads, status answers per second, and the effect of slow
    clients.
    """
    server = Server(folder, 1, 32)
    before = server.facts()
    start = time.monotonic()
    answers = asyncio.run(_together(server.port, upload(content), 100))
    uploads = {
        "answers": Counter(code for code, _ in answers),
        "seconds": round(time.monotonic() - start, 2),
        "server": server.facts(),
    }
    ids = [state["id"] for code, state in answers if code == 202]
    for id in ids:
        asyncio.run(post(server.port, head("DELETE", f"{SCENES}/{id}")))
    id = asyncio.run(post(server.port, upload(content)))[1]["id"]
    while asyncio.run(states(server.port, [id]))[id]["ended"] is None:
        time.sleep(0.5)
    busy = server.busy()
    a_second = asyncio.run(rate(server.port, id, 8, 8))
    busy = (server.busy() - busy) / max(1, 8 * a_second)
    alone = summary(asyncio.run(latencies(server.port, id, 5)))
    slow = asyncio.run(_slow(server, id, upload(content)))
    time.sleep(12)
    left = server.facts()
    server.end(signal.SIGTERM)
    return {
        "server at first": before,
        "100 uploads at once": uploads,
        "status, answers a second": round(a_second),
        "status, ms of the processor": round(1000 * busy, 2),
        "status, ms": alone,
        "slow clients": slow,
        "server when they have gone": left,
    }


async def _slow(server: Server, id: str, request: bytes) -> dict[str, Any]:
    """How others are served while 200 clients send half of a request head and 20 send a photo byte
    by byte.
    """
    connections = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(220)]
    for k, (_, writer) in enumerate(connections):
        writer.write(request[:20] if k < 200 else request[:400])
    found = await latencies(server.port, id, 5)
    facts = server.facts()
    for _, writer in connections:
        writer.close()
    return {"status, ms": summary(found), "server": facts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=480)
    parser.add_argument("--photos", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    for name in ("side", "photos", "workers"):
        if getattr(given, name) < 1:
            raise InputError(f"--{name} {getattr(given, name)}: must be at least 1")
    if given.output is not None:
        check_writable(given.output)
    random.seed(given.seed)
    content = photo(given.side)
    results: dict[str, Any] = {
        "cores": os.cpu_count(),
        "load before": round(statistics.fmean(os.getloadavg()), 1),
    }
    with tempfile.TemporaryDirectory() as folder:
        results["crowd"] = crowd(Path(folder, "crowd"), content)
        print(json.dumps(results), flush=True)
        results["killed"] = killed_in_between(
            Path(folder, "killed"), content, given.photos, given.workers
        )
    text = json.dumps(results, indent=1)
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    sys.exit(run_script(main))
