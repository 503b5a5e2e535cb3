"""The residual's training: steps a second on samples that were made before."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import interpolate
from torch.nn.utils import clip_grad_norm_

from spackle.device import pick_dtype
from spackle.evaluation.suite.clock import CPU, MS, TOTAL, Lap, measure
from spackle.evaluation.suite.flops import counted
from spackle.evaluation.suite.values import Found, Need, Row
from spackle.formats import save_png
from spackle.render import Renderer
from spackle.residual import ResidualNet
from spackle.training.data import Cache
from spackle.training.features import FeatureNet, SqueezeNet
from spackle.training.method import Objective
from spackle.training.recipe import LossRecipe
from spackle.training.residual_method import complete_samples
from spackle.training.sample import load_sample
from spackle.training.sources import Composites

BATCH, CELLS = 4, 96
PHOTOS, PHOTO = 4, (420, 560)
CROPS, VIEWS = 3, 64  # crops of a view at most; so many views have crops enough
DISPARITY = (0.3, 0.3)
LOAD, FORWARD, LOSS, BACKWARD, UPDATE = "load samples", "network, compose, render", "losses", "backward", "optimiser"
STAGES = (LOAD, FORWARD, LOSS, BACKWARD, UPDATE)
STEP, RATE = "one step", "steps a second"


def training_section(
    runs: int,
    renderer: Renderer,
    *,
    batch: int = BATCH,
    cells: int = CELLS,
    features: bool = True,
    device: torch.device = CPU,
) -> Found:
    """Steps as `spackle train` takes them, one process, SqueezeNet with random weights for the perceptual loss.

    Args:
        runs: steps that count.
        renderer: draws everything.
        batch: samples a step.
        cells: along a sample's side, of 2×2 pixels.
        features: with the perceptual loss.
        device: of the networks.
    """
    torch.manual_seed(0)
    net: FeatureNet | None = SqueezeNet().to(device) if features else None
    dtype = pick_dtype("auto", device)
    judge = Objective(LossRecipe(feature_size=None), net, renderer, dtype, device)
    network = ResidualNet().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), 1e-4)
    with tempfile.TemporaryDirectory() as folder:
        files = make_samples(Path(folder), renderer, batch, cells)
        picks = np.random.default_rng(0)

        def step(lap: Lap) -> None:
            samples = [load_sample(files[pick]) for pick in picks.permutation(len(files))[:batch]]
            lap(LOAD)
            seen = complete_samples(network, samples, renderer, dtype)
            lap(FORWARD)
            loss, _ = judge.total(seen)
            lap(LOSS)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            lap(BACKWARD)
            clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            lap(UPDATE)

        operations = counted(lambda: step(lambda name: None))
        times = measure(runs, {"step": step}, device)
    weights = sum(p.numel() * p.element_size() for p in network.parameters())
    # Weights and both moments are read and written, the gradient is written and read.
    needs = {STEP: Need(8.0 * weights, {_kind(dtype): operations}), UPDATE: Need(7.0 * weights)}
    rows = [Row(name, times["step", name], need=needs.get(name)) for name in STAGES]
    rows.append(Row(STEP, times["step", TOTAL], need=needs[STEP]))
    rows.append(Row(RATE, tuple(MS / ms for ms in times["step", TOTAL]), "1/s"))
    facts = {"batch": batch, "cells": cells, "precision": str(dtype).removeprefix("torch."), "samples": len(files)}
    return Found(tuple(rows), facts, device=device.type)


def make_samples(folder: Path, renderer: Renderer, count: int, cells: int) -> list[Path]:
    """At least `count` samples, as training would cache them, of pictures that are made up.

    Raises:
        RuntimeError: too few views had holes.
    """
    photos = [_photo(folder / f"{number}.png", number) for number in range(PHOTOS)]
    cache = Cache(folder / "cache", [Composites(photos, renderer, DISPARITY)], [1.0], 0, CROPS, cells)
    for views in itertools.count(2, 2):
        files = cache.fill(views, lambda done, total: None, lambda line: None)
        if len(files) >= count:
            return files
        if views >= VIEWS:
            break
    raise RuntimeError(f"only {len(files)} of {count} samples in {views} views")


def _photo(path: Path, seed: int) -> Path:
    """Soft patches of colour."""
    coarse = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(seed))
    save_png(interpolate(coarse, size=PHOTO, mode="bicubic").clamp(0, 1)[0].permute(1, 2, 0), path)
    return path


def _kind(dtype: torch.dtype) -> str:
    return "bf16" if dtype == torch.bfloat16 else "fp32"
