"""MoGe-2 against arrays that the original computed; focal length, sky and wrong files."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.command import report_of, run
from helpers.moge_weights import FULL, HALF, TINY, scene, shapes_of, waves, write_tiny
from helpers.photos import CLIPS, picture, write_photo
from helpers.scenes import same_bits
from torch import Tensor

from spackle.bases.depth import lift_rgbd
from spackle.bases.moge.base import SKY_DISTANCE_FACTOR, MogeBase, MogeView, to_view
from spackle.bases.moge.network import MogeOutput, load_network
from spackle.bases.open import open_base
from spackle.bases.settings import BaseSettings
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.runtime.errors import InputError

GOLDEN = dict(np.load(DATA / "moge_tiny_golden.npz"))
SIZES = {"small": (70, 98), "large": (301, 203), "square": (64, 64)}  # height, width


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("moge") / "model.pt")


@pytest.fixture(scope="module")
def base(checkpoint: Path) -> MogeBase:
    return MogeBase.load(checkpoint, precision="fp32", device="cpu")


def agrees(found: Any, name: str, tolerance: float = 2e-5) -> None:
    np.testing.assert_allclose(
        np.asarray(found), GOLDEN[name], rtol=tolerance, atol=tolerance, err_msg=name
    )


def solid(view: MogeView) -> Tensor:
    return view.surface & (view.depth > 0)


def test_the_published_vit_s_has_these_tensors() -> None:
    shapes = list(shapes_of(FULL).items())
    shapes += [
        (name, shape) for name, shape in shapes if name.startswith("points_head.")
    ]  # the head for normals
    assert (len(shapes), sum(math.prod(shape) for _, shape in shapes)) == (337, 35_103_662)


@pytest.mark.parametrize(
    ("name", "tokens", "step"), [("small", 35, 2), ("large", 120, 6), ("square", 1369, 2)]
)
def test_maps_agree_with_the_original(base: MogeBase, name: str, tokens: int, step: int) -> None:
    image = waves(*SIZES[name])
    output = base.run_network(image, tokens, SIZES[name])
    agrees(output.points[::step, ::step], f"{name}_points")
    agrees(output.metric_scale, f"{name}_metric_scale")
    agrees(output.mask_logits[::step, ::step], f"{name}_mask_logits")
    if name == "small":
        levels, _ = base.network.features(image.permute(2, 0, 1)[None], tokens)
        agrees(levels[4][0, :, ::8, ::8], "small_neck_4")


@pytest.mark.parametrize(
    ("name", "tokens", "fov", "step"),
    [
        ("small_infer", 35, None, 2),
        ("small_infer_fov60", 35, 60, 2),
        ("small_infer_level4", 72, None, 3),
        ("large_infer", 120, None, 6),
        ("large_infer_fov45", 120, 45, 6),
    ],
)
def test_depth_focal_length_and_mask_agree_with_the_original(
    base: MogeBase, name: str, tokens: int, fov: float | None, step: int
) -> None:
    height, width = SIZES[name.partition("_")[0]]
    output = base.run_network(waves(height, width), tokens, (height, width))
    view = to_view(output, width, height, fov and width / 2 / math.tan(math.radians(fov / 2)))
    agrees(view.focal_px / math.hypot(width, height) * 2, f"{name}_focal_converged")
    agrees(view.shift, f"{name}_shift_converged")
    sure = output.mask_logits.abs() > 1e-4
    assert torch.equal(solid(view)[sure], torch.from_numpy(GOLDEN[f"{name}_mask"])[sure])
    early = output.metric_scale * (
        float(GOLDEN[f"{name}_shift"]) - view.shift
    )  # the original stops before the minimum
    agrees(torch.where(solid(view), view.depth + early, torch.inf)[::step, ::step], f"{name}_depth")


def test_focal_length_and_shift_alone() -> None:
    rows = {"exact": (scene(-0.7, hole=False), None), "bent": (scene(-0.7, 0.05), None)}
    for name, (output, focal) in (rows | {"known": (scene(-0.7, 0.05), 1.1 * HALF)}).items():
        view = to_view(output, 160, 90, focal)
        agrees(view.focal_px / HALF, f"solver_{name}_focal_converged")
        agrees(view.shift, f"solver_{name}_shift_converged")
    output = scene(0.5, scale=2.0)
    output.points[30:60, 1::5, 2] = (
        0.2  # not among the solver's samples; these points end behind the camera
    )
    view = to_view(output, 160, 90)
    agrees(view.shift, "post_shift_converged")
    assert np.array_equal(solid(view), GOLDEN["post_mask"])
    agrees(torch.where(solid(view), view.depth, torch.inf)[::3, ::3], "post_depth")
    output.mask_logits.fill_(-1)
    assert (to_view(output, 160, 90).focal_px, to_view(output, 160, 90).shift) == (HALF, 0)


def photo_of(rgb: Tensor) -> Photo:
    return Photo(rgb, 120.0, FocalSource.ASSUMED, Path("photo.png"))


def test_whose_focal_length_is_used_and_the_distance_of_the_sky(
    base: MogeBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, output = photo_of(torch.from_numpy(picture(160, 90)) / 255), scene(0.5, scale=2.0)
    monkeypatch.setattr(base, "run_network", lambda *given: output)
    for source in (FocalSource.FOCAL_PX, FocalSource.EXIF):
        kept = base.predict(dataclasses.replace(photo, focal_source=source))
        assert (kept.camera.focal[0], kept.lens_source) == (120, "")
    seen = base.predict(photo)
    assert (seen.camera.focal[0], seen.lens_source) == (pytest.approx(1.3 * HALF, rel=1e-6), "MoGe")
    assert float(seen.gaussians.means[:, 2].max()) == pytest.approx(
        SKY_DISTANCE_FACTOR * 8, rel=0.02
    )
    points = output.points
    for factor in (-1, 30, 0.03):  # mirrored, 174° and 2°
        output = dataclasses.replace(output, points=points * torch.tensor([factor, factor, 1]))
        assert (base.predict(photo).camera.focal[0], base.predict(photo).lens_source) == (120, "")
    output.mask_logits.fill_(-1)
    with pytest.raises(InputError, match=r"photo\.png: MoGe finds no surface"):
        base.predict(photo)


def test_the_same_photo_gives_the_same_scene_and_bf16_nearly_so(checkpoint: Path) -> None:
    found = []
    for precision in ("fp32", "fp32", "bf16"):
        settings: dict[str, Any] = {
            "checkpoint": checkpoint,
            "precision": precision,
            "device": "cpu",
        }
        found.append(
            open_base(BaseSettings(name="moge", **settings)).predict(photo_of(waves(70, 98)))[0]
        )
    assert same_bits(found[0].gaussians, found[1].gaussians)
    assert found[2].notes["precision"] == "bf16"
    middles = [float(each.gaussians.means[:, 2].median()) for each in found]
    assert middles[2] == pytest.approx(middles[0], rel=0.02)


def test_predict_takes_a_checkpoint_and_a_clip_keeps_one_lens(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--base", "moge", "-c", checkpoint, "-o", tmp_path)
    done = run("predict", write_photo(tmp_path / "photo.png", 160, 90), *words, "--frames", 2)
    assert (done.code, report_of(tmp_path / "photo")["base"]["name"]) == (0, "moge"), done.err
    lenses, seen = iter((1.3, 0.9, 1.1)), list[float]()

    def ask(*given: Any) -> MogeOutput:
        stretch = 1.3 / next(lenses)
        output = scene(0.5)
        return dataclasses.replace(
            output, points=output.points * torch.tensor([stretch, stretch, 1])
        )

    monkeypatch.setattr(MogeBase, "run_network", ask)
    monkeypatch.setattr(
        "spackle.bases.depth.lift_rgbd",
        lambda *given, **named: (seen.append(given[2].focal[0]), lift_rgbd(*given, **named))[1],
    )
    done = run("predict", CLIPS / "large.mp4", *words, "--residual", "none")
    assert (done.code, report_of(tmp_path / "large")["focal_source"]) == (0, "MoGe"), done.err
    assert f"moves by disparity {report_of(tmp_path / 'large')['disparity']:g}" in done.err
    assert seen == pytest.approx([1.3 * HALF] * 3, rel=1e-5)


def changed(
    change: Callable[[dict[str, Any]], None], bytes_less: int = 0
) -> Callable[[Path], None]:
    """A function that writes a checkpoint with changed settings and no weights."""

    def write(path: Path) -> None:
        content = copy.deepcopy(TINY)
        change(content)
        torch.save({"model_config": content, "model": {"a": torch.zeros(1000)}}, path)
        path.write_bytes(path.read_bytes()[: -bytes_less or None])

    return write


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda path: path.write_bytes(pickle.dumps({"model": 1})), "not a zip file"),
        (changed(lambda c: None, bytes_less=1000), "not a zip file"),
        (lambda path: torch.save({"model": {"a": torch.zeros(1)}}, path), "no model_config"),
        (
            lambda path: torch.save({"model_config": Path("a"), "model": {}}, path),
            "not a published kind",
        ),
        (changed(lambda c: c["encoder"].update(backbone="dinov2_vitg14_reg")), "dinov2_vitg14_reg"),
        (
            changed(lambda c: c["neck"].update(resamplers=["pixel_shuffle"] * 4)),
            "a resampler is 'pixel_shuffle'",
        ),
        (changed(lambda c: c["mask_head"].update(res_block_in_norm="group_norm")), "group_norm"),
        (changed(lambda c: c["points_head"].update(num_res_blocks=[10**9] * 5)), "num_res_blocks"),
        (changed(lambda c: None), "303 missing"),
    ],
)
def test_wrong_files_are_refused_in_a_line(
    tmp_path: Path, write: Callable[[Path], None], said: str
) -> None:
    path = tmp_path / "model.pt"
    write(path)
    line = rf"^{re.escape(str(path))}: .*{said}.*: give MoGe-2's model\.pt as it was downloaded$"
    with pytest.raises(InputError, match=line):
        load_network(path, torch.float32)
