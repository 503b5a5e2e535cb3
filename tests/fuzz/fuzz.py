"""Feeds damaged files to the readers: `make fuzz N=5000`, or `python tests/fuzz/fuzz.py --replay CASE.json`.

Each case follows from its reader's name and its number alone. A reader may raise `InputError` and nothing else, within
10 s and 1.5 GB. All run in one child process whose memory the kernel bounds; the parent goes on behind a case that
kills it.
"""

from __future__ import annotations

import argparse
import base64
import faulthandler
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent / "evaluation"), str(HERE.parents[1] / "src")]

SECONDS, BYTES = 10, 1_500_000_000  # at most, of a case
FAILURES = Path("fuzz-failures")
NUMBERS = [b"0", b"-1", b"1e300", b"-1e39", b"1e-300", b"nan", b"inf", b"9" * 400, b"9" * 5000, b"2147483648", b"0.5"]
WORDS = [b"", b"null", b"true", b"[]", b"{}", b'""', b"\x1b[2J", b"\0", b"../../etc/passwd", b"[" * 10_000]
WORDS += [b'"\\ud800"', b"*a"]
VALUES: list[Any] = [None, True, 0, -1, 1.5, 1e300, 10**400, "", "../x", "a" * 5000, "\x1b[2J"]
VALUES += [[], {}, [[]], ["a"], {"a": {}}]

Files = dict[str, bytes]


def mutated(files: Files, rng: np.random.Generator) -> Files:
    """The files with one to four damages."""
    done = dict(files)
    for _ in range(int(rng.integers(1, 5))):
        texts = [name for name, data in done.items() if b"\0" not in data[:2000]]
        name = str(rng.choice(texts if texts and rng.random() < 0.7 else list(done)))
        done[name] = _damaged(done[name], rng)
    return done


def _damaged(data: bytes, rng: np.random.Generator) -> bytes:
    def place() -> int:
        return int(rng.integers(len(data) + 1))

    if b"\0" not in data[:2000] and rng.random() < 0.8:
        return _damaged_text(data, rng)
    start, stop = sorted((place(), place()))
    stop = min(stop, start + int(rng.integers(1, 64)))
    match int(rng.integers(7)):
        case 0:  # bits
            array = np.frombuffer(data, np.uint8).copy()
            hit = rng.integers(0, max(1, len(array)), int(rng.integers(1, 9)))
            if len(array):
                array[hit] ^= (1 << rng.integers(0, 8, len(hit))).astype(np.uint8)
            return array.tobytes()
        case 1:  # a number of 1 to 8 bytes, most of them in the head
            at = int(len(data) * rng.random() ** 4)
            number = [b"\0" * 8, b"\xff" * 8, b"\x7f" + b"\xff" * 7, b"\x80" + b"\0" * 7, b"\xff\xff\0\0\0\0\0\0"]
            width = 1 << int(rng.integers(4))
            value = number[int(rng.integers(5))][:width]
            return data[:at] + (value[::-1] if rng.random() < 0.5 else value) + data[at + width :]
        case 2:
            return data[:start]
        case 3:
            return data[:start] + data[stop:]
        case 4:
            return data[:start] + data[start:stop] * int(rng.integers(2, 300)) + data[stop:]
        case 5:
            return data[:start] + rng.bytes(stop - start) + data[stop:]
        case _:
            other = place()
            return data[:start] + data[other : other + stop - start] + data[stop:]


def _damaged_text(data: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.6:
        try:
            content = json.loads(data)
            return json.dumps(_changed(content, rng)).encode()
        except (ValueError, RecursionError):
            pass
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    words = lines[at].replace(b",", b" , ").split(b" ")
    match int(rng.integers(7)):
        case 0 | 1 | 2:
            pool = NUMBERS if rng.random() < 0.7 else WORDS
            words[int(rng.integers(len(words)))] = pool[int(rng.integers(len(pool)))]
            lines[at] = b" ".join(words)
        case 3:
            del words[int(rng.integers(len(words)))]
            lines[at] = b" ".join(words)
        case 4:
            del lines[at]
        case 5:
            lines[at : at + 1] = [lines[at]] * int(rng.integers(2, 200))
        case _:
            lines.insert(at, [b"\n" * 30_000, b" " * 30_000, b"#" * 3000, b"\xff\xfe"][int(rng.integers(4))])
    return b"\n".join(lines)


def _changed(content: Any, rng: np.random.Generator) -> Any:
    """JSON with another value, or without one, somewhere in it."""
    if not isinstance(content, (dict, list)) or not content or rng.random() < 0.1:
        return VALUES[int(rng.integers(len(VALUES)))]
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = keys[int(rng.integers(len(keys)))]
    if rng.random() < 0.08:
        del content[key]
    else:
        content[key] = _changed(content[key], rng)
    return content


# The child ----------------------------------------------------------------------------------------


def child(names: Sequence[str], first: int, count: int, log: Path) -> None:
    """Run the cases, with a line of JSON in `log` before and after each."""
    from readers import READERS, contents

    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as place, open(log, "a", buffering=1) as out:
        seeds: dict[str, list[Files]] = {name: [] for name in names}
        for name in names:  # also loads all that is needed, before memory is bounded
            for number, make in enumerate(READERS[name].makers):
                folder = Path(place, f"{name}-{number}")
                folder.mkdir()
                make(folder)
                seeds[name].append(contents(folder))
                _problem(name, seeds[name][-1], Path(place, "case"))
        _bound_memory()
        for name in names:
            began, most = time.perf_counter(), 0
            for number in range(first, first + count):
                files = case_of(name, number, seeds[name])
                plain = {file: base64.b64encode(data).decode() for file, data in files.items()}
                out.write(json.dumps([name, number, plain]) + "\n")
                problem, took = _bounded(name, files, Path(place, "case"))
                most = max(most, took)
                out.write(json.dumps({"problem": problem}) + "\n")
            seconds = time.perf_counter() - began
            out.write(json.dumps({"reader": name, "megabytes": most / 1e6, "seconds": seconds}) + "\n")


def _bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    faulthandler.register(signal.SIGPROF, chain=True)  # a traceback, then the end


def _bounded(name: str, files: Files, folder: Path) -> tuple[str | None, int]:
    """What was wrong, and the bytes that it took; the process ends where it takes too long."""
    before = _memory("VmRSS")
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: others may be at work, too
    faulthandler.dump_traceback_later(20 * SECONDS, exit=True)  # waits for something
    problem = _problem(name, files, folder)
    faulthandler.cancel_dump_traceback_later()
    signal.setitimer(signal.ITIMER_PROF, 0)
    took = _memory("VmHWM") - before
    return problem or (f"took {took:,} bytes" if took > BYTES else None), took


def _memory(name: str) -> int:
    """Bytes of this process: VmRSS now, or VmHWM at most since the last VmRSS."""
    found = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    if name == "VmRSS":
        Path("/proc/self/clear_refs").write_text("5")  # sets VmHWM back
    return 1024 * int(found.split()[1])


def case_of(name: str, number: int, seeds: Sequence[Files]) -> Files:
    """The files of a case."""
    from readers import sealed

    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    files = mutated(seeds[number % len(seeds)], rng)
    return sealed(files) if rng.random() < 0.8 else files


def _problem(name: str, files: Files, folder: Path) -> str | None:
    """What a reader did that it must not do."""
    from av import FFmpegError
    from readers import READERS

    from spackle.errors import InputError

    shutil.rmtree(folder, ignore_errors=True)
    for file, data in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(data)
    try:
        READERS[name].read(folder)
    except InputError as error:
        links = [cause := error]
        while cause := cause.__cause__ or cause.__context__:
            links.append(cause)
        # FFmpeg itself refuses any block over 2 GB, with the same error as where there is no memory.
        if not any(isinstance(link, FFmpegError) for link in links) and any(
            isinstance(link, MemoryError) or "allocate" in str(link) for link in links
        ):
            return f"took more than {BYTES:,} bytes: {error}"
    except Exception:
        return traceback.format_exc(limit=-4)
    return None


# The parent ---------------------------------------------------------------------------------------


def fuzz(names: Sequence[str], count: int, first: int = 0) -> Iterator[tuple[str, int, str, dict[str, str]]]:
    """Run `count` cases of each reader: of each failure its name, the number, what is wrong, and the files (base64)."""
    with tempfile.TemporaryDirectory() as place:
        waiting = [(list(names), first, count)]
        while waiting:
            now, start, many = waiting.pop()
            log = Path(place, "log")
            log.write_bytes(b"")
            command = [sys.executable, __file__, "--child", json.dumps(now), str(start), str(many), str(log)]
            environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
            done = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True)
            lines = [json.loads(line) for line in log.read_text().splitlines()]
            case: list[Any] = []
            for line in lines:
                if isinstance(line, list):
                    case = line
                elif "reader" in line:
                    print(
                        f"{line['reader']}: {many} cases, {line['seconds']:.1f} s, {line['megabytes']:,.0f} MB at most",
                        file=sys.stderr,
                    )
                elif line["problem"]:
                    yield case[0], case[1], line["problem"], case[2]
            if done.returncode and not case:
                raise RuntimeError(done.stderr)
            if done.returncode:  # it died in this case
                name, number, files = case
                yield name, number, f"ended the process ({done.returncode}):\n{done.stderr[-2000:]}", files
                later = now[now.index(name) + 1 :]
                waiting += [(later, start, many)] if later else []
                waiting += [([name], number + 1, start + many - number - 1)] if number + 1 < start + many else []


def replayed(*paths: Path) -> list[str]:
    """What saved cases do in a process of their own, a line each."""
    done = subprocess.run([sys.executable, __file__, "--replay", *paths], capture_output=True, text=True)
    return (done.stdout + done.stderr).splitlines()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=300, help="cases of each reader")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--readers", nargs="*", help="only these")
    parser.add_argument("--replay", type=Path, nargs="+", help="cases that were written here before")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        names, first, count, log = given.child
        child(json.loads(names), int(first), int(count), Path(log))
        return 0
    if given.replay:
        import readers  # noqa: F401  # before memory is bounded

        problems = []
        with tempfile.TemporaryDirectory() as place:
            _bound_memory()
            for case in map(json.loads, map(Path.read_text, given.replay)):
                files = {file: base64.b64decode(data) for file, data in case["files"].items()}
                problems.append(_bounded(case["reader"], files, Path(place, "case"))[0])
                print(problems[-1] or "as it should be", flush=True)
        return any(problems)
    from readers import READERS

    failed = 0
    for name, number, problem, files in fuzz(given.readers or list(READERS), given.n, given.first):
        failed += 1
        print(f"{save(name, number, files)}: {problem}\n", file=sys.stderr)
    print(f"{failed} failures", file=sys.stderr)
    return bool(failed)


def save(name: str, number: int, files: dict[str, str], folder: Path = FAILURES) -> Path:
    """Write a case for --replay."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}-{number}.json"
    path.write_text(json.dumps({"reader": name, "number": number, "files": files}))
    return path


if __name__ == "__main__":
    sys.exit(main())
