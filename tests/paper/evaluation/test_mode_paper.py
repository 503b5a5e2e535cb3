"""`--mode paper` is the method `paper` of an evaluation."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.command import refuses, run
from helpers.holes import random_network
from helpers.photos import write_pair
from helpers.scenes import same_bits

import spackle
from spackle.bases.depth import RgbdBase
from spackle.bases.open import wrap_loaded_base
from spackle.bases.settings import BaseSettings
from spackle.core.gaussians import Gaussians
from spackle.formats.camera_set import CameraSet
from spackle.formats.ply import PlyFile
from spackle.paper.evaluation.case import known_depth, load_case
from spackle.paper.evaluation.evaluation import Evaluation, open_evaluation
from spackle.paper.evaluation.methods import make_method
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.paper.evaluation.protocols import large_views
from spackle.pipeline import FillOptions, Pipeline, PipelineOptions
from spackle.residual import MIN_AUX_GAUSSIANS, hole_mask
from spackle.runtime.progress import LogReporter
from spackle.views import GivenPath


def opened(root: Path, network: spackle.residual.ResidualNet | None) -> Evaluation:
    options = EvaluateOptions(
        dataset="middlebury",
        root=root,
        methods=("paper",),
        metrics=(),
        disparities=(0.02, 0.4),  # nearly no hole, and large ones
        base=BaseSettings(name="rgbd"),
        residual="initial",
    )
    return dataclasses.replace(open_evaluation(options), network=network)


@pytest.mark.parametrize("name", ["unet", "sharp-decoder", None])
def test_the_pipeline_adds_the_gaussians_of_the_evaluation_bit_for_bit(
    scenes: Path, name: str | None
) -> None:
    network = None if name is None else random_network(name=name)
    evaluation = opened(scenes, network)
    case = load_case(evaluation.cases[0], evaluation.options.max_side)
    prediction, _ = evaluation.base_of_case(case).predict(case.full_photo)
    views = large_views(prediction, evaluation.options.disparities, evaluation.options.max_side)
    cameras = [view.camera for view in views]

    pipeline = Pipeline(
        options=PipelineOptions(
            base=BaseSettings(name="rgbd"), fill=FillOptions(residual="initial", mode="paper")
        ),
        base=wrap_loaded_base(RgbdBase(known_depth(case.case))),
        network=network,
        renderer=evaluation.renderer,
        given_path=GivenPath(
            cameras=CameraSet(
                source=Path("views.json"),
                kind="Spackle",
                cameras=tuple(camera.to(dtype=torch.float64) for camera in cameras),
                names=("",) * len(cameras),
                origin=None,
            )
        ),
    )
    completed = pipeline.complete(case.full_photo, LogReporter(False))
    scene = completed.scene
    assert scene.by_view is not None
    for camera, filled_camera in zip(cameras, completed.views.cameras, strict=True):
        assert torch.equal(camera.world_to_camera, filled_camera.world_to_camera)
        assert torch.equal(camera.K, filled_camera.K)

    context = evaluation.fill_context(prediction)
    assert same_bits(scene.base, context.base)
    fill = make_method("paper", cameras, context)
    counts = []
    for index, camera in enumerate(cameras):
        rendering = context.renderer.render(context.base, camera)
        expected = fill(camera, rendering).aux
        assert expected is not None
        assert same_bits(scene.by_view[index], expected)
        holes = int(hole_mask(rendering.alpha)[::2, ::2].sum())
        assert len(expected) == max(holes, MIN_AUX_GAUSSIANS)
        counts.append(len(expected))
    # One view has too few holes, another has enough.
    assert min(counts) == MIN_AUX_GAUSSIANS < max(counts)


@pytest.mark.usefixtures("short_paths")
def test_the_command_writes_the_papers_gaussians(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path / "pair")
    words = ("predict", photo, "--depth", depth, "-o", tmp_path, "--no-render", "--mode", "paper")
    done = run(*words, "--keep-base", "--disparity", 0.2)
    assert done.code == 0, done.err
    scene = spackle.predict(photo, depth, mode="paper", disparity=0.2)
    written = PlyFile(tmp_path / "photo" / "scene.ply").gaussians()
    assert torch.equal(written.means, Gaussians.cat([scene.base, scene.aux]).means)
    assert len(scene.aux) >= MIN_AUX_GAUSSIANS
    # Each cell has one Gaussian; a texture would give one more to each pixel.
    in_view_mode = spackle.predict(photo, depth, mode="view", disparity=0.2)
    assert len(scene.aux) < len(in_view_mode.aux)
    refuses(run(*words, "--fill", "lama"), "--fill lama", "no texture", "--mode view")
    with pytest.raises(spackle.InputError, match="`mode` papers is unknown"):
        spackle.predict(photo, depth, mode="papers")  # type: ignore[arg-type]
    with pytest.raises(spackle.InputError, match="`fill` exemplar: the paper's method adds no"):
        spackle.predict(photo, depth, mode="paper", fill="exemplar")
