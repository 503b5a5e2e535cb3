"""The metrics that an evaluation measures, ready to be applied to rendered views."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

from torch import Tensor

from spackle.paper.evaluation.measurements import REMARK_METRIC
from spackle.paper.evaluation.metrics import METRICS, psnr, ssim_average, ssim_map
from spackle.paper.evaluation.published_metrics import Metric
from spackle.paper.training.feature_networks import FeatureNet
from spackle.paper.training.losses import hole_distance
from spackle.runtime.errors import reason_in_a_line


@dataclasses.dataclass(frozen=True)
class MetricSuite:
    """The image metrics to measure; holes and counts of Gaussians are measured anyway."""

    names: Sequence[str]  # keys of `METRICS`
    # Published metrics that were loaded; a name without an entry is skipped.
    published: Mapping[str, Metric] = dataclasses.field(default_factory=dict)
    # The network of the metric "distance"; None: it is skipped.
    features: FeatureNet | None = None

    def measure(
        self, rgb: Tensor, true_picture: Tensor | None, hole: Tensor
    ) -> Iterator[tuple[str, float | str]]:
        """Measure a rendered view, and yield the name and value of each number.

        Published metrics are networks of another package; one that fails gives NaN, and a remark
        with the error. PSNR and SSIM are measured three times: over the view, in the hole
        ("psnr_hole") and outside ("psnr_outside").

        Args:
            rgb: [H, W, 3] the view, sRGB 0..1.
            true_picture: [H, W, 3] what the view should be; None: metrics that need it are skipped.
            hole: [H, W] bool, where the base alone shows a hole.
        """
        for name in self.names:
            if name in self.published:
                if true_picture is not None or not METRICS[name].needs_true_picture:
                    yield from self._measure_published(name, rgb, true_picture)
            elif true_picture is None:
                continue  # all metrics that are computed here compare with the true picture
            elif name == "psnr":
                yield "psnr", psnr(rgb, true_picture)
                yield "psnr_hole", psnr(rgb, true_picture, hole)
                yield "psnr_outside", psnr(rgb, true_picture, ~hole)
            elif name == "ssim":
                similarity = ssim_map(rgb, true_picture)
                yield "ssim", ssim_average(similarity)
                yield "ssim_hole", ssim_average(similarity, hole)
                yield "ssim_outside", ssim_average(similarity, ~hole)
            elif name == "distance" and self.features is not None:  # needs a network's features
                yield "distance", hole_distance(self.features, rgb, true_picture, hole)

    def _measure_published(
        self, name: str, rgb: Tensor, true_picture: Tensor | None
    ) -> Iterator[tuple[str, float | str]]:
        """Measure a view by one published metric; an error gives NaN and a remark.

        `rgb` and `true_picture` are [H, W, 3] sRGB 0..1.
        """
        # Metrics without a reference take one picture only.
        compared_picture = true_picture if METRICS[name].needs_true_picture else None
        try:
            yield name, self.published[name](rgb, compared_picture)
        except Exception as error:  # a foreign package may fail on an unusual image
            yield name, math.nan
            yield REMARK_METRIC, f"{name} failed: {reason_in_a_line(error)}"
