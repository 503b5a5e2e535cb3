"""Hash what a fixed set of commands writes, to compare two versions of the code bit for bit.

    python benchmarks/same_results.py -o before.json
    (change the code)
    python benchmarks/same_results.py --against before.json

The commands are `demo`, and `predict` of the demo's photo: with lite (three given cameras;
keyframes), with its depth in view mode, and with its depth without weights. Run both versions on
one machine, because the last bits depend on its processor and threads. Of reports, times and the
digest of the request are ignored, because they differ between runs of one version. Videos are left
out: the encoder's threads make their bytes vary, and they only show the scenes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from skimage.data import stereo_motorcycle

from spackle.cli.script_command import run_script
from spackle.runtime.errors import as_input_error
from spackle.runtime.files import check_writable

WIDTH, HEIGHT, FOCAL = 640, 432, 860.0
VARYING = ("seconds", "request")


def write_inputs(folder: Path) -> None:
    """Write the photo, its depth in metres, three cameras and a path of keyframes."""
    left, _, disparity = stereo_motorcycle()
    photo = Image.fromarray(left).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    photo.save(folder / "photo.png")
    depth = 994.978 * 0.193001 / (np.where(np.isfinite(disparity), disparity, 40) + 31.086)
    small = Image.fromarray(depth.astype(np.float32)).resize(
        (WIDTH, HEIGHT), Image.Resampling.NEAREST
    )
    np.save(folder / "depth.npy", np.asarray(small))
    K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    eyes = [(0.25, 0.0, 0.0), (-0.2, 0.1, 0.0), (0.1, -0.1, 0.15)]
    frames = [
        {"K": K, "world_to_camera": [[1, 0, 0, -x], [0, 1, 0, -y], [0, 0, 1, -z], [0, 0, 0, 1]]}
        for x, y, z in eyes
    ]
    (folder / "cameras.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "frames": frames})
    )
    keyframes = [
        {"time": time, "eye": eye, "target": [0, 0, 3]}
        for time, eye in ((0.0, [0, 0, 0]), (0.4, [0.2, -0.1, 0.1]), (0.8, [-0.2, 0, 0]))
    ]
    (folder / "path.json").write_text(json.dumps({"keyframes": keyframes}))


def commands(folder: Path) -> dict[str, list[str]]:
    """The arguments of each command, by the name of its output folder."""
    photo = ["predict", f"{folder}/photo.png"]
    depth = ["--depth", f"{folder}/depth.npy"]
    return {
        "demo": ["demo"],
        "lite-cameras": [*photo, "--base", "lite", "--cameras", f"{folder}/cameras.json"],
        "lite-path": [*photo, "--base", "lite", "--path", f"{folder}/path.json"],
        "depth-view": [*photo, *depth, "--mode", "view", "--trajectory", "swipe", "--frames", "6"],
        "depth-initial": [
            *photo,
            *depth,
            "--residual",
            "initial",
            "--frames",
            "6",
            "--stereo",
            "sbs",
            "--focal-px",
            "700",
        ],
    }


def digest(file: Path) -> str:
    """SHA-256 of a file; for reports, without the entries that vary between runs."""
    content = file.read_bytes()
    if file.name == "report.json":
        report = {key: value for key, value in json.loads(content).items() if key not in VARYING}
        content = json.dumps(report, indent=2).encode()
    return hashlib.sha256(content).hexdigest()


def read_hashes(file: Path) -> dict[str, str]:
    """The hashes by name that `-o` has written; InputError if the file cannot be used."""
    with as_input_error(file, "no hashes ({reason}): give a file that -o has written"):
        hashes = json.loads(file.read_text())
        if not isinstance(hashes, dict):
            raise TypeError("not an object")
    return hashes


def main() -> int:
    """Run the commands, print each file's hash, and return 1 if one differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, help="write the hashes here, as JSON")
    parser.add_argument("--against", type=Path, help="compare with these hashes")
    options = parser.parse_args()
    # Before the commands, which take minutes.
    before = None if options.against is None else read_hashes(options.against)
    if options.output is not None:
        check_writable(options.output)

    hashes: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder)
        for run, words in commands(folder).items():
            output = folder / run
            command = [sys.executable, "-m", "spackle", *words, "-o", str(output)]
            subprocess.run(command, check=True, capture_output=True)
            for file in sorted(output.rglob("*")):
                if file.name == "report.json" or file.suffix in (".ply", ".png"):
                    hashes[str(file.relative_to(folder))] = digest(file)
    if before is None:
        before = hashes
    differing = [
        name for name in sorted({*before, *hashes}) if before.get(name) != hashes.get(name)
    ]
    for file_name, value in hashes.items():
        print(f"{value[:16]}  {'DIFFERS  ' if file_name in differing else ''}{file_name}")
    for file_name in sorted(set(before) - set(hashes)):
        print(f"{'gone':16}  {file_name}")
    if options.output:
        options.output.write_text(json.dumps(hashes, indent=1) + "\n")
    return int(bool(differing))


if __name__ == "__main__":
    sys.exit(run_script(main))
