"""A build that is killed three times ends with the same bytes as one that is not:
`python benchmarks/dataset_kill.py --photos FOLDER`.

Takes some photos of a folder and its subfolders, gives each an invented depth (a tilted wall with a disc standing in
front of it, drawn from the photo's name) so that `--base rgbd` can be used, and builds a dataset of them twice with two
workers: once in one go, and once killed with SIGKILL at random moments and started again after each. Compares the
manifests and the shards' digests. Then flips one byte and shows what `spackle dataset verify` says. Needs about 60 MB
a photo of 448×336 in the temporary folder (TMPDIR).
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spackle.image import load_photo
from spackle.pseudo.manifest import SampleEntry, ShardEntry, load_manifest
from spackle.pseudo.photos import find_photos

SPACKLE = [sys.executable, "-c", "from spackle.cli import main; main()"]


def write_inputs(source: Path, folder: Path, count: int, seed: int) -> None:
    """Photos in the subfolders they came from, and their depth."""
    names = sorted(find_photos(source).names, key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    for name in names[:count]:
        for kind in ("photos", "depth"):
            (folder / kind / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, folder / "photos" / name)
        photo = load_photo(source / name)
        np.save((folder / "depth" / name).with_suffix(".npy"), depth_of(name, photo.width, photo.height))


def depth_of(name: str, width: int, height: int) -> NDArray[np.float32]:
    """Metres: inverse depth is linear on the wall and constant on the disc."""
    rng = np.random.default_rng(list(hashlib.sha256(name.encode()).digest()))
    y, x = np.mgrid[:height, :width] / width
    inverse = 1 / rng.uniform(3, 8) * (1 + rng.uniform(-0.4, 0.4) * (x - 0.5) + rng.uniform(0, 0.4) * y)
    disc = np.hypot(x - rng.uniform(0.3, 0.7), y - rng.uniform(0.2, 0.5)) < rng.uniform(0.1, 0.2)
    inverse[disc] = inverse.max() * rng.uniform(1.5, 2.5)
    metres: NDArray[np.float32] = (1 / inverse).astype(np.float32)
    return metres


def killed(words: Sequence[str], moments: Sequence[float]) -> list[float]:
    """Run a command, killed after each of these seconds and then to its end; the seconds each run took."""
    took = []
    for limit in [*moments, None]:
        start = time.perf_counter()
        process = subprocess.Popen(words)
        try:
            process.wait(limit)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        code = process.wait()
        took.append(time.perf_counter() - start)
        if code not in (0, -signal.SIGKILL):
            sys.exit(f"the build ended with {code}")
        print("killed" if code else "ended", f"after {took[-1]:.1f} s", flush=True)
    return took


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a dataset."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def flip(folder: Path, rng: np.random.Generator) -> tuple[ShardEntry, SampleEntry]:
    """Change a bit of a random byte; the shard and the sample that it belongs to."""
    samples = load_manifest(folder).samples
    shard, sample = samples[rng.integers(len(samples))]
    with open(folder / shard.file, "r+b") as file:
        file.seek(sample.offset + int(rng.integers(sample.size)))
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 1]))
    return shard, sample


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0, help="of the photos, the moments and the byte")
    parser.add_argument("--views", default="20")
    parser.add_argument("--workers", default="2")
    parser.add_argument("--ray", help="kill a build whose workers are on a Ray cluster, e.g. local")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(options.photos, folder, options.count, options.seed)
        build = [*SPACKLE, "dataset", "build", "--photos", f"{folder}/photos", "--depth", f"{folder}/depth"]
        build += ["--base", "rgbd", "--views", options.views, "--threads", "1", "--shard-size", "10"]
        build += ["--workers", options.workers]
        (whole,) = killed([*build, "-o", f"{folder}/whole"], [])
        # Together up to 0.9 of the time of a whole build, so that every kill finds one at work.
        moments = rng.uniform(0.05, 0.9 / max(1, options.kills), options.kills) * whole
        again = [*build, "-o", f"{folder}/killed", *(["--ray", options.ray] if options.ray else [])]
        killed(again, moments.tolist())
        files, others = digests(folder / "whole"), digests(folder / "killed")
        for file in sorted({*files, *others}):
            print(file, files.get(file, "missing")[:16], others.get(file, "missing")[:16])
        manifest = load_manifest(folder / "whole")
        same = "the same bytes" if files == others else "NOT the same bytes"
        print(f"{same}: {len(manifest.samples)} photos, {manifest.views} views, {len(files)} files")
        shard, sample = flip(folder / "killed", rng)
        verify = [*SPACKLE, "dataset", "verify", f"{folder}/killed"]
        done = subprocess.run(verify, check=False, capture_output=True, text=True)
        named = f"{shard.file}: sample {sample.key} ({sample.photo}) is damaged" in done.stderr
        print(f"one bit of {sample.key} flipped; verify: {done.stderr.strip()} (exit code {done.returncode})")
        sys.exit(0 if files == others and named and done.returncode == 1 else 1)


if __name__ == "__main__":
    main()
