"""Feeds damaged files to the readers: `make fuzz N=5000`, or `python tests/fuzz/fuzz.py --replay
CASE.json`.

A reader's name and a case's number determine the case. A reader may raise `InputError` and nothing
else, within 10 s of the processor and 1.5 GB. Cases run in forked processes of bounded memory;
after a failed case a new process continues.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import ctypes
import faulthandler
import gc
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = map(str, [HERE, HERE.parent, HERE.parents[1] / "src"])

# The limits of a case. Seconds are those of the processor, whatever else runs on the machine; no
# seed of a few kilobytes takes one of them.
SECONDS = 10
BYTES = 1_500_000_000
FAILURES = Path("fuzz-failures")
NUMBERS = [
    b"0",
    b"-1",
    b"1e300",
    b"-1e39",
    b"1e-300",
    b"nan",
    b"inf",
    b"9" * 400,
    b"9" * 5000,
    b"2147483648",
    b"0.5",
]
WORDS = [
    b"",
    b"null",
    b"true",
    b"[]",
    b"{}",
    b'""',
    b"\x1b[2J",
    b"\0",
    b"../../etc/passwd",
    b"[" * 10_000,
]
WORDS += [b'"\\ud800"', b"*a"]
LINES = [b"\n" * 30_000, b" " * 30_000, b"#" * 3000, b"\xff\xfe"]
HEADS = [
    b"\0" * 8,
    b"\xff" * 8,
    b"\x7f" + b"\xff" * 7,
    b"\x80" + b"\0" * 7,
    b"\xff\xff\0\0\0\0\0\0",
]
VALUES: list[Any] = [None, True, 0, -1, 1.5, 1e300, 10**400, "", "../x", "a" * 5000, "\x1b[2J"]
VALUES += [[], {}, [[]], ["a"], {"a": {}}]

Files = dict[str, bytes]


def pick(rng: np.random.Generator, items: Sequence[Any]) -> Any:
    return items[int(rng.integers(len(items)))]


def is_text(data: bytes) -> bool:
    return b"\0" not in data[:2000]


def mutated(files: Files, rng: np.random.Generator) -> Files:
    """The files with one to four damages."""
    done = dict(files)
    for _ in range(int(rng.integers(1, 5))):
        texts = [name for name, data in done.items() if is_text(data)]
        name = pick(rng, texts if texts and rng.random() < 0.7 else list(done))
        damage = damaged_text if is_text(done[name]) and rng.random() < 0.8 else damaged_bytes
        done[name] = damage(done[name], rng)
    return done


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    start, stop, other = map(
        int, [*np.sort(rng.integers(len(data) + 1, size=2)), rng.integers(len(data) + 1)]
    )
    stop = min(stop, start + int(rng.integers(1, 64)))
    kind = int(rng.integers(7))
    if kind == 0 and data:  # bits
        array = np.frombuffer(data, np.uint8).copy()
        hit = rng.integers(0, len(array), int(rng.integers(1, 9)))
        array[hit] ^= (1 << rng.integers(0, 8, len(hit))).astype(np.uint8)
        return array.tobytes()
    if kind == 1:  # a number of 1 to 8 bytes, most often in the head
        start = int(len(data) * rng.random() ** 4)
        number = pick(rng, HEADS)[: 1 << int(rng.integers(4))]
        return data[:start] + number[:: pick(rng, [1, -1])] + data[start + len(number) :]
    if kind == 6:  # the end is missing
        return data[:start]
    repeated, random = data[start:stop] * int(rng.integers(2, 300)), rng.bytes(stop - start)
    return (
        data[:start]
        + [b"", b"", repeated, random, data[other : other + stop - start], b""][kind]
        + data[stop:]
    )


def damaged_text(data: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.6:
        try:
            return json.dumps(changed(json.loads(data), rng)).encode()
        except (ValueError, RecursionError):
            pass
    lines = data.split(b"\n")
    at, kind = int(rng.integers(len(lines))), int(rng.integers(7))
    words = lines[at].replace(b",", b" , ").split(b" ")
    if kind < 4:
        words[int(rng.integers(len(words)))] = (
            b"" if kind == 3 else pick(rng, NUMBERS if rng.random() < 0.7 else WORDS)
        )
        lines[at] = b" ".join(words)
    else:
        lines[at : at + 1] = [
            [],
            [lines[at]] * int(rng.integers(2, 200)),
            [pick(rng, LINES), lines[at]],
        ][kind - 4]
    return b"\n".join(lines)


def changed(content: Any, rng: np.random.Generator) -> Any:
    """JSON in which one value is replaced or missing."""
    if not isinstance(content, (dict, list)) or not content or rng.random() < 0.1:
        return pick(rng, VALUES)
    key = pick(rng, list(content) if isinstance(content, dict) else range(len(content)))
    if rng.random() < 0.08:
        del content[key]
    else:
        content[key] = changed(content[key], rng)
    return content


def save(name: str, number: int, files: Files, path: Path) -> Path:
    """Write a case for --replay."""
    path.parent.mkdir(exist_ok=True)
    coded = {file: base64.b64encode(data).decode() for file, data in files.items()}
    path.write_text(json.dumps({"reader": name, "number": number, "files": coded}))
    return path


def read(name: str, files: Files, place: Path) -> None:
    from readers import READERS

    for file, data in files.items():
        (place / file).parent.mkdir(parents=True, exist_ok=True)
        (place / file).write_bytes(data)
    READERS[name](place)


def problem_of(name: str, files: Files) -> str | None:
    """A text about a forbidden behaviour of a reader; None if there is none."""
    from av import FFmpegError

    from spackle.runtime.errors import InputError

    with tempfile.TemporaryDirectory() as place:
        try:
            read(name, files, Path(place))
        except InputError as error:
            links: list[BaseException] = [error]
            while cause := links[-1].__cause__ or links[-1].__context__:
                links.append(cause)
            # FFmpeg refuses any block over 2 GB, with the same error as for missing memory.
            if not any(isinstance(link, FFmpegError) for link in links) and any(
                isinstance(link, MemoryError) or "allocate" in str(link) for link in links
            ):
                return f"took more than {BYTES:,} bytes: {error}"
        except Exception:
            return traceback.format_exc(limit=-4)
    return None


def bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    faulthandler.register(signal.SIGPROF, chain=True)  # a traceback, then the end


def bounded(name: str, files: Files, seconds: int = SECONDS) -> str | None:
    """`problem_of`; the process ends if the reader takes too long."""
    signal.setitimer(signal.ITIMER_PROF, seconds)  # processor time, because other programs may run
    faulthandler.dump_traceback_later(60 * seconds, exit=True)  # for a reader that waits
    problem = problem_of(name, files)
    faulthandler.cancel_dump_traceback_later()
    signal.setitimer(signal.ITIMER_PROF, 0)
    return problem


def case_of(name: str, seeds: Sequence[Files], number: int) -> Files:
    from readers import sealed

    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    files = mutated(seeds[number % len(seeds)], rng)
    return sealed(files) if rng.random() < 0.8 else files


def run_cases(name: str, seeds: Sequence[Files], numbers: range, case: Path, said: Path) -> None:
    """Run cases up to the first failure; the file `case` then holds this case, and `said` the
    problem.
    """
    with open(said, "w") as file:
        os.dup2(file.fileno(), sys.stderr.fileno())
    bound_memory()
    for number in numbers:
        files = case_of(name, seeds, number)
        save(name, number, files, case)
        if problem := bounded(name, files):
            sys.exit(problem)


def seeds_of(name: str) -> list[Files]:
    """Valid files for a reader; those that claim a huge size may be refused as they are."""
    from readers import BOMBS, sealed, stored_files

    from spackle.runtime.errors import InputError

    seeds = stored_files(name)
    for files in seeds:  # also loads all modules, before memory is bounded
        refusal = (InputError,) if name in BOMBS else ()
        with tempfile.TemporaryDirectory() as place, contextlib.suppress(*refusal):
            read(name, sealed(files), Path(place))
    return seeds


def held(name: str, count: int) -> list[int]:
    """Additional threads, open files and MB of this process after `count` cases without garbage
    collection.
    """
    seeds, process = seeds_of(name), Path("/proc/self")
    gc.disable()

    def counts() -> list[int]:
        pages = int((process / "statm").read_text().split()[1])
        return [
            len(os.listdir(process / "task")),
            len(os.listdir(process / "fd")),
            pages * resource.getpagesize() >> 20,
        ]

    before = counts()
    for number in range(count):
        if problem := problem_of(name, case_of(name, seeds, number)):
            sys.exit(problem)
    return [after - start for start, after in zip(before, counts(), strict=True)]


def fuzz(name: str, count: int) -> int:
    """The number of failed cases of a reader; each is written to FAILURES, and the problem is
    printed.
    """
    seeds = seeds_of(name)
    first = failed = 0
    with tempfile.TemporaryDirectory() as place:
        case, said = Path(place, "case.json"), Path(place, "said")
        while first < count:
            case.unlink(missing_ok=True)
            arguments = name, seeds, range(first, count), case, said
            process = multiprocessing.get_context("fork").Process(target=run_cases, args=arguments)
            process.start()
            process.join()
            if process.exitcode == 0:
                break
            first, failed = json.loads(case.read_text())["number"] + 1, failed + 1
            FAILURES.mkdir(exist_ok=True)
            kept = shutil.copy(case, FAILURES / f"{name}-{first - 1}.json")
            print(f"{kept}: ended with {process.exitcode}: {said.read_text()[-2000:]}", flush=True)
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=300, help="cases of each reader")
    parser.add_argument("--readers", nargs="*", help="only these")
    parser.add_argument(
        "--held", action="store_true", help="print the threads, files and MB that one process keeps"
    )
    parser.add_argument("--replay", type=Path, nargs="+", help="files of FAILURES")
    parser.add_argument(
        "--seconds", type=int, default=SECONDS, help="of the processor for a replayed case"
    )
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    os.environ["OMP_NUM_THREADS"] = "1"  # threads take memory, and do not survive a fork
    ctypes.CDLL(None).mallopt(-8, 2)  # at most two heaps, because each heap takes 64 MB
    from readers import READERS

    if given.replay:
        bound_memory()
        problems = []
        for case in map(json.loads, map(Path.read_text, given.replay)):
            files = {file: base64.b64decode(data) for file, data in case["files"].items()}
            problems.append(bounded(case["reader"], files, given.seconds))
            print(problems[-1] or "as it should be", flush=True)
        return any(problems)
    if given.held:
        for name in given.readers or READERS:
            print(name, *held(name, given.n))
        return 0
    return sum(fuzz(name, given.n) for name in given.readers or READERS) > 0


if __name__ == "__main__":
    sys.exit(main())
