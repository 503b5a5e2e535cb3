"""Evaluate your own method beside Spackle's methods, against a true second photo.

python examples/13_evaluate_your_method.py    # needs pip install 'spackle-nvs[demo]'
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch

import spackle
from spackle.bases.depth import lift_rgbd
from spackle.paper.evaluation.case import Viewpoint
from spackle.paper.evaluation.datasets.stereo import load_motorcycle
from spackle.paper.evaluation.measurements import Measurement
from spackle.paper.evaluation.methods import Fill, MethodView, make_method
from spackle.paper.evaluation.metric_suite import MetricSuite
from spackle.paper.evaluation.protocols import measure_views


def mean_color(camera: spackle.Camera, before: spackle.Rendering) -> MethodView:
    """Your method: gets a view and the base rendered from this view, and returns an image."""
    hole = spackle.hole_mask(before.alpha)
    return MethodView(
        torch.where(hole[..., None], before.rgb[~hole].mean(dim=0), before.rgb), None, None
    )


def main() -> list[Measurement]:
    pair = load_motorcycle()
    prediction = lift_rgbd(pair.left, pair.depth, pair.left_camera)
    context = spackle.FillContext.of(prediction, spackle.get_renderer())
    views = [Viewpoint("near", "right", pair.right_camera, lambda: pair.right)]
    methods: dict[str, Callable[[Sequence[spackle.Camera]], Fill]] = {
        "mine": lambda cameras: mean_color
    }
    methods |= {
        name: partial(make_method, name, context=context) for name in ("base", "initial", "spackle")
    }
    measurements, _ = measure_views(
        "Middlebury", "Motorcycle", context, views, methods, MetricSuite(["psnr", "ssim"])
    )
    return measurements


if __name__ == "__main__":
    for measurement in main():
        print(measurement.method, measurement.metric, measurement.value)
