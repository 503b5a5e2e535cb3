"""What an evaluation found, in a sentence or two."""

from __future__ import annotations

from spackle.evaluation.methods import METHODS
from spackle.evaluation.results import Run
from spackle.evaluation.tables import NEAR, count_text

HEADLINES = {  # figures of near views: what they are, their unit, digits
    "psnr_hole": ("PSNR in the hole, higher is better", " dB", 2),
    "distance": ("Masked perceptual distance in the hole, lower is better", "", 3),
}


def findings(run: Run) -> list[str]:
    """Sentences, from means over all views."""
    return _near(run) if run.near else [line for move in run.config["disparities"] if (line := _large(run, move))]


def _large(run: Run, move: float) -> str | None:
    """How much a disparity leaves open, before and after."""
    method = next((name for name in ("spackle", "spackle-scene", "seeds", "dense") if name in run.methods), None)
    if method is None:
        return None
    before, after, added, share = (
        run.mean(figure, method, f"{move:g}").value for figure in ("har_before", "har", "aux", "aux_share")
    )
    if before is None or after is None or added is None or share is None:
        return None
    return (
        f"At disparity {move:g} the base alone leaves {percent(before)} of the pixels open, {METHODS[method].title} "
        f"{percent(after)}, with {count_text(added)} added Gaussians a view ({percent(share)} of the base's)."
    )


def _near(run: Run) -> list[str]:
    lines = []
    for figure, (says, unit, digits) in HEADLINES.items():
        means = {method: run.mean(figure, method, NEAR).value for method in run.methods}
        told = [f"{METHODS[m].title} {v:.{digits}f}{unit}" for m, v in means.items() if v is not None]
        if told:
            lines.append(f"{says}: {', '.join(told)}.")
    return lines


def percent(share: float) -> str:
    """With as many digits as it takes to see it."""
    return "0 %" if share == 0 else f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.1g} %"
