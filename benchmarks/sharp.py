"""Compare SHARP in Spackle with the original: one photo to a PLY on disk, each in its own process.

python benchmarks/sharp.py --original CHECKOUT [--original-python PYTHON] [--weights FILE.pt]
[--photo FILE]

CHECKOUT is a clone of github.com/apple/ml-sharp, PYTHON an interpreter with its requirements
installed. Without --weights, deterministic ones are made (2.8 GB in the temporary folder). Prints a
Markdown table of seconds per stage, seconds of the whole process, and peak resident memory; then
how far the Gaussians and two renders differ.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

STAGES = ("import", "build and load", "network", "post-processing", "save")


class Clock:
    """Takes the seconds of named stages, which follow each other."""

    def __init__(self, device: str) -> None:
        self.device, self.seconds, self.last = device, dict[str, float](), time.perf_counter()

    def lap(self, stage: str) -> None:
        if self.device != "cpu":
            import torch

            torch.cuda.synchronize()
        now = time.perf_counter()
        self.seconds[stage] = now - self.last
        self.last = now


def run_original(clock: Clock, weights: Path, photo: Path, output: Path, *, checkout: str) -> None:
    """Do what the original's `sharp predict` does, with timed stages."""
    sys.path.insert(0, f"{checkout}/src")
    import torch

    spec = importlib.util.find_spec("torchvision")
    if spec is not None and spec.submodule_search_locations is not None:
        declare_operators(Path(spec.submodule_search_locations[0]))
    from sharp.cli import predict  # type: ignore[import-not-found]
    from sharp.utils import io  # type: ignore[import-not-found]

    clock.lap("import")
    network = predict.create_predictor(predict.PredictorParams())
    network.load_state_dict(torch.load(weights, weights_only=True))
    network.eval().to(clock.device)
    clock.lap("build and load")

    def unproject(*arguments: Any) -> Any:
        clock.lap("network")
        return original_unproject(*arguments)

    original_unproject, predict.unproject_gaussians = predict.unproject_gaussians, unproject
    image, _, focal_px = io.load_rgb(photo)
    gaussians = predict.predict_image(network, image, focal_px, torch.device(clock.device))
    clock.lap("post-processing")
    predict.save_ply(gaussians, focal_px, image.shape[:2], output)
    clock.lap("save")


def declare_operators(folder: Path, namespace: str = "torchvision") -> list[str]:
    """Declare the operators of torchvision that are missing; returns their names.

    If torch is of another build, torchvision's compiled operators do not load, and its import fails
    at the first one. The original uses only torchvision's Python code, so declaring the names is
    enough.
    """
    import torch

    for compiled in folder.glob("_C*.so"):
        with contextlib.suppress(OSError, RuntimeError):  # for another build of torch
            torch.ops.load_library(compiled)
    text = (folder / "_meta_registrations.py").read_text()
    names = sorted(set(re.findall(r'register_(?:meta|fake)\("(?:torchvision::)?(\w+)"', text)))
    missing = [name for name in names if not hasattr(getattr(torch.ops, namespace), name)]
    library = torch.library.Library(namespace, "FRAGMENT")
    for name in missing:
        library.define(f"{name}(Tensor x) -> Tensor")
    # the names exist as long as this object
    vars(declare_operators).setdefault("kept", []).append(library)
    return missing


def run_ours(clock: Clock, weights: Path, photo: Path, output: Path, **options: Any) -> None:
    """Do the same with Spackle."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line sets it
    import spackle
    from spackle.bases.sharp.base import to_metric

    clock.lap("import")
    base = spackle.SharpBase.load(weights, device=clock.device, **options)
    clock.lap("build and load")
    picture = spackle.load_photo(photo)
    found = base.infer(picture)
    clock.lap("network")
    gaussians = to_metric(found, picture)
    clock.lap("post-processing")
    spackle.save_ply(gaussians, output, camera=picture.camera)
    clock.lap("save")


def measure(name: str, python: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Run one contender as a child process: seconds of its stages and from start to exit, and peak
    memory in GB.
    """
    print(f"{name} …", file=sys.stderr, flush=True)
    start = time.perf_counter()
    call = [python, __file__, "--child", json.dumps(arguments, default=str)]
    child = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    lines = child.stdout.read().splitlines()
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        sys.exit(f"{name} failed")
    whole = {"total": time.perf_counter() - start, "memory": usage.ru_maxrss * 1024 / 1e9}
    return {"name": name, **json.loads(lines[-1]), **whole}


def compare(ply: Path, reference: Path) -> str:
    """A text about the differences between two files of the same Gaussians."""
    import torch

    import spackle
    from spackle.formats import PlyFile

    ours, theirs = spackle.load_ply(ply), spackle.load_ply(reference)
    rows = []
    for name in ("means", "covariances", "opacities", "colors"):
        a, b = (
            g.covariances() if name == "covariances" else getattr(g, name) for g in (ours, theirs)
        )
        rows.append(f"{name} {float((a - b).norm() / b.norm()):.1e}")
    camera = PlyFile(ply).camera()
    assert camera is not None
    eye = torch.tensor([0.05 * float(theirs.means[:, 2].median()), 0.0, 0.0])
    views = {
        "at the photo": camera,
        "from the side": camera.looking(eye, torch.tensor([0.0, 0.0, 5.0])),
    }
    for name, view in views.items():
        one, other = (spackle.get_renderer("cpu").render(g, view).rgb for g in (ours, theirs))
        rows.append(f"render {name} {float(-10 * (one - other).square().mean().log10()):.1f} dB")
    return ", ".join(rows)


def print_table(results: list[dict[str, Any]]) -> None:
    """Print a Markdown table with a row for each contender; ratios are relative to the first."""
    print(
        f"\n| | {' | '.join(STAGES)} | whole process | peak memory | whole | post-processing + "
        f"save |"
    )
    print(f"|---|{'---|' * (len(STAGES) + 4)}")
    post = [r["post-processing"] + r["save"] for r in results]
    for r, own in zip(results, post, strict=True):
        ratios = f"{results[0]['total'] / r['total']:.1f}× | {post[0] / own:.1f}×"
        stages = " | ".join(f"{r[stage]:.2f}" for stage in STAGES)
        print(f"| {r['name']} | {stages} | {r['total']:.1f} s | {r['memory']:.1f} GB | {ratios} |")
    print()


def make_inputs(weights: Path | None, photo: Path | None, folder: Path) -> tuple[Path, Path]:
    """Weights and photo; by default deterministic weights, which are made here, and the demo's
    photo.
    """
    if weights is None:
        weights = Path(tempfile.gettempdir()) / "sharp_deterministic.pt"
        if not weights.exists():
            subprocess.run(
                [sys.executable, Path(__file__).with_name("random_weights.py"), weights], check=True
            )
    if photo is None:
        from skimage import data, io

        photo = folder / "motorcycle.png"
        io.imsave(photo, data.stereo_motorcycle()[0])
    return weights, photo


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--original", type=Path, help="a checkout of apple/ml-sharp; without it only ours runs"
    )
    parser.add_argument("--original-python", default=sys.executable)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--photo", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        call = json.loads(chosen.child)
        clock = Clock(call.pop("device"))
        paths = [Path(call.pop(key)) for key in ("weights", "photo", "output")]
        (run_original if "checkout" in call else run_ours)(clock, *paths, **call)
        print(json.dumps(clock.seconds))
        return

    # Not for the child, whose first stage is the import, and where Spackle may not be installed.
    from spackle.runtime.errors import InputError
    from spackle.runtime.files import check_file

    if chosen.weights is not None:
        check_file(chosen.weights, "file of SHARP's weights")
    if chosen.photo is not None:
        check_file(chosen.photo, "photo")
    if chosen.original is not None and not (chosen.original / "src" / "sharp").is_dir():
        raise InputError(f"{chosen.original}: has no src/sharp: give a clone of apple/ml-sharp")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        weights, photo = make_inputs(chosen.weights, chosen.photo, folder)
        common = {"weights": weights, "photo": photo, "device": chosen.device}
        contenders: dict[str, dict[str, Any]] = (
            {"original": {"checkout": chosen.original}} if chosen.original else {}
        )
        contenders |= {"Spackle": {}, "Spackle, --sharp-windows 1": {"windows_per_batch": 1}}
        contenders |= {"Spackle, fp32": {"precision": "fp32"}}
        outputs = {label: folder / f"{index}.ply" for index, label in enumerate(contenders)}
        results = []
        for label, more in contenders.items():
            python = chosen.original_python if label == "original" else sys.executable
            results.append(measure(label, python, {**common, **more, "output": outputs[label]}))
        print_table(results)
        reference = "original" if chosen.original else "Spackle, fp32"
        for label in contenders:
            if label != reference:
                print(
                    f"- {label} against {reference}: {compare(outputs[label], outputs[reference])}"
                )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:  # the original's Python may have no Spackle
        main()
    else:
        from spackle.cli.script_command import run_script

        sys.exit(run_script(main))
