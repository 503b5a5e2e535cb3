"""SHARP against the original, side by side: one photo to a PLY on disk, each in a process of its own.

python benchmarks/sharp.py --original CHECKOUT [--original-python PYTHON] [--weights FILE.pt] [--photo FILE]

CHECKOUT is a clone of github.com/apple/ml-sharp, PYTHON an interpreter that has its requirements. Without --weights
deterministic ones are made (2.8 GB in the temporary folder). Prints a Markdown table: seconds of each stage, the whole
process as its parent sees it, and the peak of its resident memory; then how far the Gaussians and two
renders are apart.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

STAGES = ("import", "build and load", "network", "post-processing", "save")


class Clock:
    """Seconds of named stages, one after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self.last
        self.last = now


def run_original(weights: Path, photo: Path, output: Path, device: str, checkout: Path) -> dict[str, float]:
    """What the original's `sharp predict` does, with a clock in it."""
    clock = Clock()
    sys.path.insert(0, str(checkout / "src"))
    import torch

    _declare_torchvision_operators(torch)
    from sharp.cli import predict  # type: ignore[import-not-found]
    from sharp.utils import io  # type: ignore[import-not-found]

    clock.lap("import")
    network = predict.create_predictor(predict.PredictorParams())
    network.load_state_dict(torch.load(weights, weights_only=True))
    network.eval().to(device)
    clock.lap("build and load")

    def unproject(*arguments: Any) -> Any:
        _wait(device)
        clock.lap("network")
        return original_unproject(*arguments)

    original_unproject, predict.unproject_gaussians = predict.unproject_gaussians, unproject
    image, _, focal_px = io.load_rgb(photo)
    gaussians = predict.predict_image(network, image, focal_px, torch.device(device))
    _wait(device)
    clock.lap("post-processing")
    predict.save_ply(gaussians, focal_px, image.shape[:2], output)
    clock.lap("save")
    return clock.seconds


def run_ours(weights: Path, photo: Path, output: Path, device: str, options: dict[str, Any]) -> dict[str, float]:
    """The same with Spackle."""
    clock = Clock()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does
    import spackle
    from spackle.bases.sharp.base import to_metric, to_processor

    clock.lap("import")
    base = spackle.SharpBase.load(weights, device=device, **options)
    clock.lap("build and load")
    picture = spackle.load_photo(photo)
    output_of_network = base.look(picture)
    _wait(device)
    clock.lap("network")
    gaussians = to_processor(to_metric(output_of_network, picture))
    clock.lap("post-processing")
    spackle.save_ply(gaussians, output, camera=picture.camera)
    clock.lap("save")
    return clock.seconds


def _declare_torchvision_operators(torch: Any) -> None:
    """Beside a CPU-only torch, torchvision's compiled operators do not load, and its import stops at the first.

    The original uses its Python parts only, so the names suffice.
    """
    import importlib.util

    spec = importlib.util.find_spec("torchvision")
    if spec is None or spec.submodule_search_locations is None or torch.cuda.is_available():
        return
    text = (Path(spec.submodule_search_locations[0]) / "_meta_registrations.py").read_text()
    library = torch.library.Library("torchvision", "DEF")
    for name in sorted(set(re.findall(r'register_(?:meta|fake)\("(?:torchvision::)?(\w+)"', text))):
        library.define(f"{name}(Tensor x) -> Tensor")
    _declare_torchvision_operators.kept = library  # type: ignore[attr-defined]  # it lasts as long as the names


def _wait(device: str) -> None:
    if device != "cpu":
        import torch

        torch.cuda.synchronize()


def measure(name: str, python: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Run one contender as a child; its stages, the seconds from start to exit, and its peak memory in GB."""
    print(f"{name} …", file=sys.stderr, flush=True)
    start = time.perf_counter()
    child = subprocess.Popen(
        [python, __file__, "--child", json.dumps(arguments, default=str)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    lines = child.stdout.read().splitlines()
    _, status, usage = os.wait4(child.pid, 0)
    total = time.perf_counter() - start
    if status:
        sys.exit(f"{name} failed")
    return {"name": name, **json.loads(lines[-1]), "total": total, "memory": usage.ru_maxrss * 1024 / 1e9}


def compare(ply: Path, reference: Path) -> str:
    """How far two files of the same Gaussians are apart."""
    import torch

    import spackle
    from spackle.formats import load_ply_camera

    ours, theirs = spackle.load_ply(ply), spackle.load_ply(reference)
    rows = []
    pairs: dict[str, Callable[[spackle.Gaussians], torch.Tensor]] = {
        "means": lambda g: g.means,
        "covariances": lambda g: g.covariances(),
        "opacities": lambda g: g.opacities,
        "colors": lambda g: g.colors,
    }
    for name, column in pairs.items():
        a, b = column(ours), column(theirs)
        rows.append(f"{name} {float((a - b).norm() / b.norm()):.1e}")
    camera = load_ply_camera(ply)
    assert camera is not None
    eye = torch.tensor([0.05 * float(theirs.means[:, 2].median()), 0.0, 0.0])
    views = {"at the photo": camera, "from the side": camera.looking(eye, torch.tensor([0.0, 0.0, 5.0]))}
    for name, view in views.items():
        one, other = (spackle.get_renderer("cpu").render(g, view).rgb for g in (ours, theirs))
        error = float((one - other).square().mean())
        rows.append(f"render {name} {-10 * torch.tensor(error).log10():.1f} dB")
    return ", ".join(rows)


def table(results: list[dict[str, Any]]) -> str:
    """Markdown, a contender a row; ratios are to the first."""
    post = {r["name"]: r["post-processing"] + r["save"] for r in results}
    first = results[0]
    lines = [
        f"| | {' | '.join(STAGES)} | whole process | peak memory | whole | post-processing + save |",
        f"|---|{'---|' * (len(STAGES) + 4)}",
    ]
    for r in results:
        stages = " | ".join(f"{r[stage]:.2f}" for stage in STAGES)
        ratios = f"{first['total'] / r['total']:.1f}× | {post[first['name']] / post[r['name']]:.1f}×"
        lines.append(f"| {r['name']} | {stages} | {r['total']:.1f} s | {r['memory']:.1f} GB | {ratios} |")
    return "\n".join(lines)


def processor() -> str:
    """The machine in words."""
    try:
        found = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    except OSError:
        found = None
    return f"{found.group(1) if found else platform.processor()}, {os.cpu_count()} cores"


def make_inputs(weights: Path | None, photo: Path | None, folder: Path) -> tuple[Path, Path]:
    """Deterministic weights and scikit-image's Motorcycle where nothing is given."""
    if weights is None:
        from spackle.jobs.weights import make_weights
        from spackle.progress import Reporter

        weights = Path(tempfile.gettempdir()) / "sharp_deterministic.pt"
        if not weights.exists():
            make_weights(weights, "full", Reporter())
    if photo is None:
        import skimage.data
        from PIL import Image

        photo = folder / "motorcycle.png"
        Image.fromarray(skimage.data.stereo_motorcycle()[0]).save(photo)
    return weights, photo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--original", type=Path, help="a checkout of apple/ml-sharp; without it only ours runs")
    parser.add_argument("--original-python", default=sys.executable)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--photo", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.child:
        call = json.loads(chosen.child)
        kind, device = call.pop("kind"), call.pop("device")
        paths = [Path(call.pop(key)) for key in ("weights", "photo", "output")]
        rest = [Path(call["checkout"])] if kind == "original" else [call]
        seconds = (run_original if kind == "original" else run_ours)(*paths, device, *rest)  # type: ignore[operator]
        print(json.dumps(seconds))
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        weights, photo = make_inputs(chosen.weights, chosen.photo, folder)
        common = {"weights": weights, "photo": photo, "device": chosen.device}
        contenders: dict[str, tuple[str, dict[str, Any]]] = {}
        if chosen.original:
            contenders["original"] = (chosen.original_python, {"kind": "original", "checkout": chosen.original})
        contenders["Spackle"] = (sys.executable, {"kind": "ours"})
        contenders["Spackle, --low-memory"] = (sys.executable, {"kind": "ours", "low_memory": True})
        contenders["Spackle, fp32"] = (sys.executable, {"kind": "ours", "precision": "fp32"})
        outputs = {label: folder / f"{index}.ply" for index, label in enumerate(contenders)}
        results = [
            measure(label, python, {**common, **arguments, "output": outputs[label]})
            for label, (python, arguments) in contenders.items()
        ]
        print(f"\n{processor()}, {chosen.device}\n\n{table(results)}\n")
        reference = "original" if chosen.original else "Spackle, fp32"
        for label in contenders:
            if label != reference:
                print(f"- {label} against {reference}: {compare(outputs[label], outputs[reference])}")


if __name__ == "__main__":
    main()
