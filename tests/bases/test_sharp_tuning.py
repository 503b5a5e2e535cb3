"""SHARP's decoder as it is trained: exact gradients, and a file of its own that predicts beside its checkpoint."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from photos import picture
from safetensors import safe_open
from safetensors.torch import save_file
from scenes import shifted
from sharp_weights import MICRO
from torch import Tensor

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.base import NOTE, Owner, decoder_bytes, expected_shapes, link_owner
from spackle.bases.sharp.encoder import CONFIGS
from spackle.camera import Camera
from spackle.cli.weights import deterministic_weights
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.render import get_renderer
from spackle.training.direct_ft import TunableSharp, normalised_camera

CPU = torch.device("cpu")
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
NUDGE = 3e-4  # how far weights are moved to see what becomes of it


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Owner]:
    """A checkpoint of SHARP from 512² pixels, whose width does not tell it from the tiny one."""
    path = tmp_path_factory.mktemp("tuning") / "sharp.safetensors"
    save_file(deterministic_weights(expected_shapes(MICRO)), path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CONFIGS, "tiny", MICRO)
        yield Owner(path, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.fixture(scope="module")
def base(owner: Owner) -> TunableSharp:
    """To be read only."""
    return TunableSharp.load(owner.path, torch.float32, CPU)


def photo() -> Photo:
    return Photo(torch.from_numpy(picture(WIDTH, HEIGHT)).float() / 255, FOCAL, "--focal-px", Path("a.png"))


def gaussians_from(weights: Path) -> Gaussians:
    return SharpBase.load(weights, precision="fp32", device="cpu").predict(photo()).gaussians


# The way from the decoder's weights to a picture --------------------------------------------------


def test_gaussians_before_metres_are_drawn_as_they_are_in_metres(base: TunableSharp) -> None:
    with torch.no_grad():
        before = base.gaussians(base.network.gaussian_decoder(), base.see(photo().rgb, CAMERA))
    after = SharpBase(base.network).predict(photo()).gaussians
    aside = CAMERA.looking(torch.tensor([0.2, -0.1, 0.1]), torch.tensor([0.0, 0.0, 4.0]))
    # The second one has pixels that are not square, as after rounding to a working size.
    for view in (CAMERA, shifted(CAMERA, 0.3).resized(WIDTH, HEIGHT + 6), aside):
        one = get_renderer().render(before, normalised_camera(view, CAMERA))
        other = get_renderer().render(after, view)
        for name, tolerance in (("rgb", 1e-4), ("alpha", 1e-4), ("depth", 1e-3)):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", ["prediction_head.", "feature_model.texture_head.", "feature_model.decoder."])
def test_gradients_from_gaussians_to_weights_are_those_of_finite_differences(base: TunableSharp, name: str) -> None:
    """Along the gradient itself, without rendering: its cut-offs are steps, which no gradient sees."""
    decoder = copy.deepcopy(base.network.gaussian_decoder()).let_learn()
    seen = base.see(photo().rgb, CAMERA)

    def loss() -> Tensor:
        random = torch.Generator().manual_seed(0)
        tensors = base.gaussians(decoder, seen).tensors
        return torch.stack([(t.double() * torch.randn(t.shape, generator=random)).mean() for t in tensors]).sum()

    loss().backward()
    named = [(key, weight) for key, weight in decoder.named_parameters() if key.startswith(name)]
    weights = [weight for _, weight in named if weight.requires_grad]
    assert all(weight.grad is not None for weight in weights)
    length = float(torch.stack([weight.grad.norm() for weight in weights]).norm())
    found = []
    with torch.no_grad():
        for step in (NUDGE, -2 * NUDGE):
            for weight in weights:
                weight.add_(weight.grad, alpha=step / length)
            found.append(float(loss()))
    assert (found[0] - found[1]) / (2 * NUDGE) == pytest.approx(length, rel=0.005)


# A decoder's own file -----------------------------------------------------------------------------


def test_a_decoders_file_finds_its_checkpoint_and_holds_it_to_its_digest(
    owner: Owner, base: TunableSharp, tmp_path: Path
) -> None:
    best, beside = tmp_path / "best.safetensors", tmp_path / "sharp.safetensors"
    best.write_bytes(decoder_bytes(base.network.gaussian_decoder(), owner))
    other = deterministic_weights(expected_shapes(MICRO))
    other["prediction_head.texture_prediction_head.bias"] += 1
    # The link is renewed, and counts more than another file of the checkpoint's name.
    save_file(other, beside)
    for where in (tmp_path / "where it lay once", owner.path, owner.path):
        link_owner(Owner(where, owner.sha256), tmp_path)
    expected = gaussians_from(owner.path).tensors
    assert all(map(torch.equal, gaussians_from(best).tensors, expected))
    with safe_open(best, framework="pt") as opened:
        notes, tensors = opened.metadata(), {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    assert str(owner.path.parent) not in str(notes)

    # Without the link: a file of that name beside it, if it is the right one.
    alone = tmp_path / "alone"
    alone.mkdir()
    best, beside = alone / "best.safetensors", alone / "sharp.safetensors"
    moved = {**json.loads(notes[NOTE]), "checkpoint": "/elsewhere/sharp.safetensors"}
    save_file(tensors, best, {NOTE: json.dumps(moved)})
    with pytest.raises(InputError, match=r"trained on sharp\.safetensors, which is not beside it: put"):
        SharpBase.load(best)
    beside.symlink_to(owner.path)
    assert all(map(torch.equal, gaussians_from(best).tensors, expected))
    beside.unlink()
    save_file(other, beside)
    with pytest.raises(InputError, match="trained on a checkpoint with the SHA-256"):
        SharpBase.load(best)
    beside.unlink()
    beside.symlink_to(owner.path)
    name = min(tensors)
    save_file({key: value for key, value in tensors.items() if key != name}, best, notes)
    with pytest.raises(InputError, match=f"1 names differ, e.g. {name}"):
        SharpBase.load(best)
    save_file(tensors, best, {NOTE: "{}"})
    with pytest.raises(InputError, match="does not say which checkpoint it was trained on"):
        SharpBase.load(best)
