"""Evaluate your own method beside Spackle's methods, against a true second photo.

python examples/13_evaluate_your_method.py    # needs pip install 'spackle-nvs[demo]'

On a whole dataset, in the folder of this file:

spackle evaluate pairs --dataset pairs --methods base,spackle,13_evaluate_your_method:mean_color
"""

from collections.abc import Sequence
from functools import partial

import torch

import spackle
from spackle.bases.depth import lift_rgbd
from spackle.paper.evaluation.case import Viewpoint
from spackle.paper.evaluation.datasets.stereo import load_motorcycle
from spackle.paper.evaluation.measurements import Measurement
from spackle.paper.evaluation.methods import Fill, MethodView, make_method
from spackle.paper.evaluation.metric_suite import MetricSuite
from spackle.paper.evaluation.protocols import Method, measure_views


def mean_color(cameras: Sequence[spackle.Camera], context: spackle.FillContext) -> Fill:
    """Your method: gets the cameras of all views and the base; returns what fills one view."""

    def fill(camera: spackle.Camera, before: spackle.Rendering) -> MethodView:
        """A view, from its camera and the base rendered from this camera."""
        hole = spackle.hole_mask(before.alpha)
        rgb = torch.where(hole[..., None], before.rgb[~hole].mean(dim=0), before.rgb)
        return MethodView(rgb=rgb, alpha=None, aux=None)

    return fill


def main() -> list[Measurement]:
    pair = load_motorcycle()
    prediction = lift_rgbd(pair.left, pair.depth, pair.left_camera)
    context = spackle.FillContext.of(prediction, spackle.get_renderer())
    views = [Viewpoint("near", "right", pair.right_camera, lambda: pair.right)]
    methods: dict[str, Method] = {"mine": partial(mean_color, context=context)}
    for name in ("base", "initial", "spackle"):
        methods[name] = partial(make_method, name, context=context)
    suite = MetricSuite(["psnr", "ssim"])
    measurements, _ = measure_views("Middlebury", "Motorcycle", context, views, methods, suite)
    return measurements


if __name__ == "__main__":
    for measurement in main():
        print(measurement.method, measurement.metric, measurement.value)
