"""The lite base with the weights in the package, on a real photo and on photos of other shapes."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
import torch
from depth_loss import score_depth, vertical_ramp
from helpers.scenes import same_bits
from safetensors.torch import load_file, save_file
from torch.nn.functional import interpolate
from weights import save_networks

import spackle
from spackle.bases.lite import (
    MAX_DEPTH_RATIO,
    SCALE_SUFFIX,
    SHIPPED_WEIGHTS,
    LiteBase,
    LiteNet,
    load_networks,
)
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.depth.units import RELATIVE_NEAR_M
from spackle.runtime.errors import InputError


@functools.cache
def shipped() -> LiteBase:
    return LiteBase.load(device="cpu")


@functools.cache
def motorcycle() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The left photo at half size [H, W, 3], its depth up to a factor, and where it is known."""
    data = pytest.importorskip("skimage.data")
    left, _, disparity = data.stereo_motorcycle()
    rgb = torch.from_numpy(left[::2, ::2].copy()).float() / 255
    known = torch.from_numpy(disparity[::2, ::2].copy())
    valid = torch.isfinite(known)
    return rgb, 1 / (known.where(valid, 1.0) + 31.086), valid  # 31.086 is the pair's doffs


def test_depth_of_a_real_photo_beats_a_ramp_and_a_plane() -> None:
    rgb, depth, valid = motorcycle()
    seen = shipped().inverse_depth(rgb)
    seen = interpolate(seen[None, None], size=depth.shape, mode="bilinear", align_corners=False)[
        0, 0
    ]
    found = score_depth(seen, depth, valid)
    for guess in (vertical_ramp(*depth.shape), torch.ones_like(depth)):
        assert found.abs_rel < 0.9 * score_depth(guess, depth, valid).abs_rel
    assert found.delta > 0.8


def test_the_same_photo_gives_the_same_scene_and_its_colours() -> None:
    rgb = motorcycle()[0][:96, :128]
    photo = Photo(rgb, 140.8, FocalSource.ASSUMED, Path("photo.png"))
    one, other = (shipped().predict(photo) for _ in range(2))
    assert same_bits(one.gaussians, other.gaussians)
    view = spackle.get_renderer("cpu").render(one.gaussians, one.camera)
    assert float((view.rgb - rgb).abs().mean()) < 0.05
    assert float(view.alpha.min()) > 0.95
    z = one.gaussians.means[:, 2]
    assert one.notes["depth_scale"] == f"relative, the nearest at {RELATIVE_NEAR_M:g} m"
    assert RELATIVE_NEAR_M * 0.9 < float(z.min()) < RELATIVE_NEAR_M * 1.5
    assert float(z.max()) < RELATIVE_NEAR_M * MAX_DEPTH_RATIO * 10


@pytest.mark.parametrize("shape", [(40, 3000), (17, 17), (1, 1)])
def test_a_photo_of_any_shape_has_finite_depth(shape: tuple[int, int]) -> None:
    small = torch.rand(*shape, 3, generator=torch.Generator().manual_seed(0))
    assert bool(torch.isfinite(shipped().inverse_depth(small)).all())


def test_stored_weights_are_small_and_only_rounded(tmp_path: Path) -> None:
    assert SHIPPED_WEIGHTS.stat().st_size <= 12_000_000
    assert [network.encoder.size for network in load_networks(SHIPPED_WEIGHTS)] == [
        "lite0",
        "lite2",
    ]
    networks = [LiteNet("lite2"), LiteNet("lite0")]
    save_networks(networks, tmp_path / "two.safetensors")
    read = load_networks(tmp_path / "two.safetensors")
    assert [network.encoder.size for network in read] == ["lite2", "lite0"]
    for one, other in zip(networks, read, strict=True):
        for weight, stored in zip(one.parameters(), other.parameters(), strict=True):
            rows, off = (t.reshape(len(t), -1).abs().amax(1) for t in (weight, weight - stored))
            assert bool((off <= rows / 254 * 1.001 + 1e-7).all())
    count = sum(weight.numel() for network in networks for weight in network.parameters())
    assert (tmp_path / "two.safetensors").stat().st_size < 1.1 * count


@pytest.mark.parametrize(
    "missing",
    ["0.context.weight", f"0.context.weight{SCALE_SUFFIX}", "0.encoder.stages.6.0.project.bias"],
)
def test_weights_with_a_missing_tensor_are_refused_in_one_line(
    tmp_path: Path, missing: str
) -> None:
    save_networks([LiteNet()], tmp_path / "one.safetensors")
    tensors = load_file(tmp_path / "one.safetensors")
    del tensors[missing]
    save_file(tensors, tmp_path / "harmed.safetensors")
    problem = r"another network's weights(: encoder\.stages| \(1 missing \(context\.weight\))"
    with pytest.raises(InputError, match=rf"harmed\.safetensors: {problem}"):
        LiteBase.load(tmp_path / "harmed.safetensors")
