"""The lite base with the weights that ship: what it says of a real photo, and what it makes of others."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
import torch
from torch.nn.functional import interpolate

import spackle
from spackle.bases.lite.base import FARTHEST, INPUT_PIXELS, NEAREST_M, SHIPPED, LiteBase, network_size
from spackle.bases.lite.network import STRIDE, LiteNet
from spackle.errors import InputError
from spackle.image import Photo
from spackle.training.depth.score import score_depth, vertical_ramp


@functools.cache
def shipped() -> LiteBase:
    return LiteBase.load(device="cpu")


def photo_of(rgb: torch.Tensor) -> Photo:
    return Photo(rgb, 1.1 * rgb.shape[1], "default 30 mm", Path("photo.png"))


@functools.cache
def motorcycle() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The left photo at half size [H, W, 3], and its disparity over the focal length and baseline, with validity."""
    data = pytest.importorskip("skimage.data")
    left, _, disparity = data.stereo_motorcycle()
    rgb = torch.from_numpy(left[::2, ::2].copy()).float() / 255
    known = torch.from_numpy(disparity[::2, ::2].copy())
    valid = torch.isfinite(known)
    return rgb, 1 / (known.where(valid, 1.0) + 31.086), valid  # depth but for its unit; the pair's doffs


def test_a_real_photo_comes_out_nearer_to_its_measured_depth_than_by_a_guess_without_looking() -> None:
    rgb, depth, valid = motorcycle()
    seen = shipped().inverse_depth(rgb)
    seen = interpolate(seen[None, None], size=depth.shape, mode="bilinear", align_corners=False)[0, 0]
    found = score_depth(seen, depth, valid)
    for guess in (vertical_ramp(*depth.shape), torch.ones_like(depth)):
        assert found.abs_rel < 0.9 * score_depth(guess, depth, valid).abs_rel
    assert found.delta > 0.8


def test_a_mirrored_photo_has_nearly_the_mirrored_depth_and_quite_where_all_sizes_are_seen_both_ways() -> None:
    rgb, *_ = motorcycle()
    seen, mirrored = (shipped().looks(picture).mean(0) for picture in (rgb, rgb.flip(1)))
    assert float((mirrored - seen.flip(1)).abs().mean()) < 0.02
    seen, mirrored = (shipped().looks(picture, INPUT_PIXELS[:-1]).mean(0) for picture in (rgb, rgb.flip(1)))
    torch.testing.assert_close(mirrored, seen.flip(1), rtol=1e-3, atol=1e-4)


def test_the_same_photo_gives_the_same_scene_and_its_colours() -> None:
    rgb = motorcycle()[0][:96, :128]
    one, other = (shipped().predict(photo_of(rgb)) for _ in range(2))
    for a, b in zip(one.gaussians.tensors, other.gaussians.tensors, strict=True):
        assert torch.equal(a, b)
    view = spackle.get_renderer("cpu").render(one.gaussians, one.camera)
    assert float((view.rgb - rgb).abs().mean()) < 0.05
    assert float(view.alpha.min()) > 0.95


def test_depth_lies_in_the_range_that_the_report_names() -> None:
    prediction = shipped().predict(photo_of(motorcycle()[0][:128, :160]))
    z = prediction.gaussians.means[:, 2]
    assert prediction.notes["depth_scale"] == f"relative, the nearest at {NEAREST_M:g} m"
    assert NEAREST_M * 0.9 < float(z.min()) < NEAREST_M * 1.5
    assert float(z.max()) < NEAREST_M * FARTHEST * 10  # what is taken for sky stands behind all else


@pytest.mark.parametrize(("height", "width"), [(480, 640), (1536, 864), (40, 3000), (17, 17), (1, 1)])
def test_the_network_sees_any_photo_at_its_own_size_and_nearly_in_its_shape(height: int, width: int) -> None:
    for pixels in INPUT_PIXELS:
        tall, wide = network_size(height, width, pixels)
        assert tall % STRIDE == 0
        assert wide % STRIDE == 0
        if 0.5 < height / width < 2:
            assert 0.65 * pixels < tall * wide < 1.4 * pixels
            assert abs(tall - (pixels * height / width) ** 0.5) <= STRIDE / 2
            assert abs(wide - (pixels * width / height) ** 0.5) <= STRIDE / 2
            assert 0.75 < (tall / wide) / (height / width) < 1.33
    small = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    if height * width < 200_000:
        assert bool(torch.isfinite(shipped().inverse_depth(small)).all())


def test_the_weights_are_small_and_of_the_network_that_reads_them() -> None:
    assert SHIPPED.stat().st_size <= 12_000_000
    assert sum(weight.numel() for weight in LiteNet().parameters()) * 2 <= SHIPPED.stat().st_size


def test_weights_of_another_network_are_refused_in_a_line(tmp_path: Path) -> None:
    from spackle.residual.weights import SHIPPED as RESIDUAL

    with pytest.raises(InputError, match=r"lite weights .* are of another network"):
        LiteBase.load(RESIDUAL)
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"\x00" * 100)
    with pytest.raises(InputError, match="not readable as safetensors"):
        LiteBase.load(broken)
    with pytest.raises(InputError, match="not found"):
        LiteBase.load(tmp_path / "none.safetensors")
