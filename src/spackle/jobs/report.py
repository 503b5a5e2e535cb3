"""What is said about a prediction once it is done."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.open import Choice
from spackle.bases.protocol import BasePrediction
from spackle.camera_path import spelled
from spackle.formats import atomic_path
from spackle.image import Photo
from spackle.jobs.options import PredictOptions
from spackle.jobs.setup import Tools
from spackle.jobs.views import Completed


def focal_source(photo: Photo, prediction: BasePrediction) -> str:
    """Who said what the focal length is: an option, the photo, the base's calibration, or nobody."""
    return prediction.lens_source or photo.focal_source


def make_report(
    photo: Photo,
    prediction: BasePrediction,
    choice: Choice,
    completed: Completed,
    options: PredictOptions,
    tools: Tools,
    holes: list[dict[str, float | str]],
    video: dict[str, object] | None,
    request: str,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Counts, holes, times and sources of one photo, ready for JSON."""
    base, aux = len(completed.base), len(completed.aux)
    given = options.cameras or options.path
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "photo": {"file": photo.path.name, "width": photo.width, "height": photo.height},
        "focal_px": round(prediction.camera.focal[0], 3),
        "focal_source": focal_source(photo, prediction),
        "base": {"name": choice.base, "chosen": choice.why, "gaussians": base, **prediction.notes},
        "residual": {"weights": tools.residual},
        "aux": {"gaussians": aux, "share": aux / base},
        "merged": base + aux,
        "mode": options.mode,
        "views": given.name if given else spelled(options.trajectory),
        "disparity": None if given else options.disparity,
        "video": video,
        "hole_area_ratio": holes,
        "request": request if choice.lasting else None,  # None: the next run does it again, see `is_done`
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
    }
    if choice.passed_over:
        report["base"]["passed_over"] = list(choice.passed_over)
    if tools.residual == "seeds":
        report["residual"]["note"] = "no trained weights: the seeds alone filled the holes"
    if completed.saved_view is not None:
        report["scene_ply_view"] = completed.saved_view  # the view whose aux Gaussians scene.ply holds
    return report


def is_done(folder: Path, results: Sequence[str], request: str) -> bool:
    """Whether an earlier run with the same files and options has finished, and its results are there still."""
    if not all((folder / name).is_file() for name in results):
        return False
    return _earlier(folder).get("request") == request


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


def write_report(report: dict[str, Any], path: Path) -> None:
    """Write a report as JSON, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def summary(report: dict[str, Any]) -> str:
    """A report in one line."""
    holes = report["hole_area_ratio"]
    before, after = (sum(view[key] for view in holes) / len(holes) for key in ("before", "after"))
    aux = report["aux"]
    return (
        f"{aux['gaussians']:,} aux Gaussians ({aux['share']:.1%}, {report['residual']['weights']}), "
        f"holes {before:.2%} -> {after:.3%}, {report['seconds']['total']:.1f} s"
    )
