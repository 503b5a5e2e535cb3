"""report.json: what is said of a photo's results once they are there, and what an earlier run said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.app.complete import CompletedPhoto, PhotoCompleter
from spackle.camera_path import spelled


def make_report(
    done: CompletedPhoto,
    completer: PhotoCompleter,
    holes: list[dict[str, float | str]],
    video: dict[str, object] | None,
    request: str,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Counts, holes, times and sources of one photo, ready for JSON."""
    photo, prediction, choice, path = done.photo, done.prediction, done.choice, completer.path
    base, aux, weights = len(done.scene.base), len(done.scene.aux), completer.residual.weights
    given = path.cameras or path.path
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "photo": {"file": photo.path.name, "width": photo.width, "height": photo.height},
        "focal_px": round(prediction.camera.focal[0], 3),
        "focal_source": prediction.lens_source or photo.focal_source,
        "base": {"name": choice.base, "chosen": choice.why, "gaussians": base, **prediction.notes},
        "residual": {"weights": weights},
        "aux": {"gaussians": aux, "share": aux / base},
        "merged": base + aux,
        "mode": completer.mode,
        "views": given.name if given else spelled(path.trajectory),
        "disparity": None if given else path.disparity,
        "video": video,
        "hole_area_ratio": holes,
        "request": request if choice.lasting else None,  # None: the next run does it again, see `is_done`
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
    }
    if choice.failures:
        report["base"]["passed_over"] = list(choice.failures)
    if weights == "seeds":
        report["residual"]["note"] = "no trained weights: the seeds alone filled the holes"
    if done.saved_view is not None:
        report["scene_ply_view"] = done.saved_view  # the view whose aux Gaussians scene.ply holds
    return report


def is_done(folder: Path, results: Sequence[str], request: str) -> bool:
    """Whether an earlier run with the same files and options has finished, and its results are there still."""
    return all((folder / name).is_file() for name in results) and _earlier(folder).get("request") == request


def base_before(folder: Path) -> str | None:
    """The base of an earlier run's results; None where there are none."""
    base = _earlier(folder).get("base")
    return str(base["name"]) if isinstance(base, dict) and "name" in base else None


def _earlier(folder: Path) -> dict[str, Any]:
    """An earlier run's report; empty without a whole one."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return report if isinstance(report, dict) else {}


def summary(report: dict[str, Any]) -> str:
    """A report in one line."""
    holes = report["hole_area_ratio"]
    before, after = (sum(view[key] for view in holes) / len(holes) for key in ("before", "after"))
    aux = report["aux"]
    return (
        f"{aux['gaussians']:,} aux Gaussians ({aux['share']:.1%}, {report['residual']['weights']}), "
        f"holes {before:.2%} -> {after:.3%}, {report['seconds']['total']:.1f} s"
    )
