"""SHARP's trained decoder: exact gradients, and a file that predicts with its checkpoint."""

from __future__ import annotations

import copy
import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.photos import picture
from helpers.scenes import shifted
from helpers.sharp_weights import MICRO_SIZE
from random_weights import deterministic_weights
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import (
    SOURCE_KEY,
    SourceCheckpoint,
    encode_decoder,
    expected_shapes,
    link_source_checkpoint,
)
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.paper.training.direct_ft import TunableSharp, normalised_camera
from spackle.render import get_renderer
from spackle.runtime.errors import InputError

CPU = torch.device("cpu")
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
NUDGE = 3e-4  # step of the finite differences


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> SourceCheckpoint:
    """A checkpoint of SHARP with an input of 512² pixels."""
    path = tmp_path_factory.mktemp("tuning") / "sharp.safetensors"
    save_file(deterministic_weights(expected_shapes(MICRO_SIZE)), path)
    return SourceCheckpoint(path, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.fixture(scope="module")
def base(owner: SourceCheckpoint) -> TunableSharp:
    return TunableSharp.load(owner.path, torch.float32, CPU)


def photo() -> Photo:
    return Photo(
        torch.from_numpy(picture(WIDTH, HEIGHT)).float() / 255,
        FOCAL,
        FocalSource.FOCAL_PX,
        Path("a.png"),
    )


def gaussians_from(weights: Path) -> Gaussians:
    return SharpBase.load(weights, precision="fp32", device="cpu").predict(photo()).gaussians


def test_normalised_gaussians_render_like_gaussians_in_metres(base: TunableSharp) -> None:
    with torch.no_grad():
        before = base.gaussians(base.network.gaussian_decoder(), base.encode(photo().rgb, CAMERA))
    after = SharpBase(base.network).predict(photo()).gaussians
    aside = CAMERA.looking(torch.tensor([0.2, -0.1, 0.1]), torch.tensor([0.0, 0.0, 4.0]))
    # The second camera has pixels that are not square, as after rounding to a working size.
    for view in (CAMERA, shifted(CAMERA, 0.3).resized(WIDTH, HEIGHT + 6), aside):
        one = get_renderer().render(before, normalised_camera(view, CAMERA))
        other = get_renderer().render(after, view)
        for name, tolerance in (("rgb", 1e-4), ("alpha", 1e-4), ("depth", 1e-3)):
            torch.testing.assert_close(
                getattr(one, name), getattr(other, name), rtol=0, atol=tolerance
            )


@pytest.mark.parametrize(
    "name", ["prediction_head.", "feature_model.texture_head.", "feature_model.decoder."]
)
def test_gradients_to_weights_are_those_of_finite_differences(
    base: TunableSharp, name: str
) -> None:
    decoder = copy.deepcopy(base.network.gaussian_decoder()).enable_training()
    encoded = base.encode(photo().rgb, CAMERA)

    def loss() -> Tensor:
        random = torch.Generator().manual_seed(0)
        tensors = base.gaussians(decoder, encoded).tensors
        return torch.stack(
            [(t.double() * torch.randn(t.shape, generator=random)).mean() for t in tensors]
        ).sum()

    loss().backward()
    weights = [
        w for key, w in decoder.named_parameters() if key.startswith(name) and w.requires_grad
    ]
    assert all(weight.grad is not None for weight in weights)
    length = float(torch.stack([weight.grad.norm() for weight in weights]).norm())
    found = []
    with torch.no_grad():
        for step in (NUDGE, -2 * NUDGE):
            for weight in weights:
                weight.add_(weight.grad, alpha=step / length)
            found.append(float(loss()))
    assert (found[0] - found[1]) / (2 * NUDGE) == pytest.approx(length, rel=0.005)


def test_a_decoders_file_finds_its_checkpoint(
    owner: SourceCheckpoint, base: TunableSharp, tmp_path: Path
) -> None:
    best, beside = tmp_path / "best.safetensors", tmp_path / "sharp.safetensors"
    best.write_bytes(encode_decoder(base.network.gaussian_decoder(), owner))
    assert str(owner.path.parent).encode() not in best.read_bytes()[:9999]
    expected = gaussians_from(owner.path).tensors
    beside.symlink_to(owner.path)  # a file of the checkpoint's name
    assert all(map(torch.equal, gaussians_from(best).tensors, expected))
    beside.unlink()
    beside.write_bytes(b"another")
    for where in (
        tmp_path / "moved",
        owner.path,
        owner.path,
    ):  # a dead link is renewed, and counts more than the name
        link_source_checkpoint(SourceCheckpoint(where, owner.sha256), tmp_path)
    assert all(map(torch.equal, gaussians_from(best).tensors, expected))


@pytest.mark.parametrize(
    ("beside", "noted", "missing", "said"),
    [
        (None, True, "", r"trained on sharp\.safetensors, which is not in this folder: put"),
        (b"another", True, "", "trained on a checkpoint with the SHA-256"),
        (
            ...,
            True,
            "feature_model.fusion.out_conv.bias",
            r"1 names differ, e\.g\. feature_model\.fusion",
        ),
        (None, False, "", "does not say which checkpoint it was trained on"),
    ],
)
def test_a_decoder_without_its_checkpoint_or_a_tensor_is_refused(
    owner: SourceCheckpoint,
    base: TunableSharp,
    tmp_path: Path,
    beside: Any,
    noted: bool,
    missing: str,
    said: str,
) -> None:
    decoder = base.network.gaussian_decoder().state_dict()
    facts = {"checkpoint": "/elsewhere/sharp.safetensors", "sha256": owner.sha256}
    note = {SOURCE_KEY: json.dumps(facts) if noted else "{}"}
    tensors = {name: tensor.contiguous() for name, tensor in decoder.items() if name != missing}
    save_file(tensors, tmp_path / "best.safetensors", note)
    if beside is not None:
        (tmp_path / "sharp.safetensors").write_bytes(
            owner.path.read_bytes() if beside is ... else beside
        )
    with pytest.raises(InputError, match=said):
        SharpBase.load(tmp_path / "best.safetensors")
