"""What the tables of efficiency have in common: how numbers are written, and what stands above and below them."""

from __future__ import annotations

import statistics
from collections.abc import Callable

from spackle.evaluation import paper_efficiency as published
from spackle.evaluation.efficiency_results import Bill, Spread

SIDE = "right"  # the end of the swipe where the second camera of Middlebury's and Booster's pairs stands
VIEW = (
    f"One view of each image: the {SIDE} end of a swipe at that disparity (spackle.camera_path.extremes), where the "
    "second camera of a stereo pair would stand; the paper does not say which view it timed"
)


def base_title(bill: Bill) -> str:
    return str(bill.config["base"]["title"])


def setting_title(setting: str, pattern: str = "{}") -> str:
    """ "S1" for 0.3, or by the pattern "S1: disparity 0.3"; a disparity that the paper has not has no such name."""
    index = published.setting_index(float(setting))
    return f"disparity {setting}" if index is None else pattern.format(f"S{index + 1}", setting)


def said(bill: Bill) -> str:
    """The view, the base, the machine: what every table of times has to say."""
    base, residual = bill.config["base"], bill.config["residual"]
    hardware, versions = bill.config["hardware"], bill.config["versions"]
    weights = "seeds, no weights"
    if residual["sha256"]:
        weights = f"{residual['weights']} weights {residual['sha256'][:8]} in {residual['precision']}, on the processor"
    network = f"network in {bill.precision} on {base['device']}" if bill.precision else "no network"
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    place = f"{hardware['cpu']}, {hardware['cores']} cores, {hardware['threads']} threads"
    place += f", {hardware['gpu']} for the base, the rest on the processor" if "gpu" in hardware else ""
    return f"{VIEW}. Base {base['title']}: {base['says']} ({network}). Residual: {weights}. Machine: {place}; {named}."


def notes(bill: Bill) -> tuple[str, ...]:
    """How it was timed, and what came in the way."""
    runs, base_runs = bill.config["runs"], bill.config["base_runs"]
    notes = [
        f"Each stage: median of {runs} runs after one that is not counted; the base: {base_runs} per image. Files are "
        "read before the clock starts, and nothing is written. A time of several stages is the sum of their medians."
    ]
    cold = [image.name for image in bill.measured if not image.facts["warm"]]
    if cold:
        notes.append(f"The base of {', '.join(cold)} was timed at its first prediction in a process: it was not warm.")
    loads = [float(image.facts["load"]) for image in bill.measured if image.facts["load"] is not None]
    if loads:
        middle = statistics.median(loads)
        notes.append(
            f"Load of the machine before each image (with this benchmark in it): median {middle:.1f}, {min(loads):.1f} "
            f"to {max(loads):.1f}; above the number of cores, others were computing and times are longer than need be."
        )
    if passed := [image.name for image in bill.images if image.problem is not None]:
        notes.append(f"{len(passed)} of {len(bill.images)} images gave no figures: {', '.join(passed[:5])}.")
    return tuple(notes)


def quartiles_text(spread: Spread, text: Callable[[float], str]) -> str:
    return f"{text(spread.median)} [{text(spread.q1)}, {text(spread.q3)}]"


def ms_text(value: float) -> str:
    return f"{value:,.1f}"


def percent_text(value: float) -> str:
    return f"{value:.1f}%"


def share_text(value: float) -> str:
    """Small overheads keep two digits: the question is whether they are below one percent."""
    return f"{100 * value:.2f}%" if value < 0.1 else f"{100 * value:.1f}%"


def rate_text(value: float) -> str:
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"
