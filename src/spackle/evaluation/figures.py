"""The metrics that can be asked for: what they are called, and exactly what they are."""

from __future__ import annotations

import dataclasses

from spackle.evaluation.pyiqa_metrics import DEFINITIONS

OWN = "own"


@dataclasses.dataclass(frozen=True)
class Figure:
    """A metric of a view."""

    title: str  # with the direction that is better
    says: str  # its definition, for captions
    lower: bool  # is better
    digits: int
    truth: bool  # needs a true second view

    def text(self, value: float) -> str:
        return f"{value:.{self.digits}f}"


METRICS: dict[str, Figure] = {
    "clipiqa": Figure("CLIPIQA ↑", DEFINITIONS["clipiqa"].says, False, 4, False),
    "niqe": Figure("NIQE ↓", DEFINITIONS["niqe"].says, True, 4, False),
    "musiq": Figure("MUSIQ ↑", DEFINITIONS["musiq"].says, False, 4, False),
    "psnr": Figure("PSNR ↑", "in dB over sRGB pixels and channels in 0..1", False, 2, True),
    "ssim": Figure(
        "SSIM ↑", "Gaussian window of 11 pixels, σ 1.5, K 0.01 and 0.03, mean of the sRGB channels", False, 4, True
    ),
    "distance": Figure(
        "distance ↓",
        "masked perceptual distance in the hole: SqueezeNet 1.0 at conv1, fire4, fire8 and fire9, unit feature "
        "vectors, 0 to 8 (spackle.training.distance.hole_distance); not LPIPS",
        True,
        4,
        True,
    ),
    "dists": Figure("DISTS ↓", DEFINITIONS["dists"].says, True, 4, True),
    "lpips": Figure("LPIPS ↓", DEFINITIONS["lpips"].says, True, 4, True),
}

PROTOCOLS = ("large-view", "near-view")
DEFAULT_METRICS = {
    "large-view": ("clipiqa", "niqe", "musiq"),
    "near-view": ("psnr", "ssim", "distance", "dists", "lpips"),
}
SPLIT = ("psnr", "ssim")  # measured over the image, in the base's hole and outside of it


def definitions(names: tuple[str, ...]) -> list[str]:
    """A sentence for each metric."""
    return [f"{METRICS[name].title[:-2]}: {METRICS[name].says}." for name in names]
