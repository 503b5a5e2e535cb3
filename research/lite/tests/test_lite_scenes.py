"""Training of the lite base: the ray tracer, turned cameras, the loss, the score and the
encoder.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from depth_loss import DepthLossWeights, depth_loss, score_depth, vertical_ramp
from frames import Frame, Turning, relit, turned
from helpers.photos import picture
from lite_data import f32
from numpy.typing import NDArray
from plain_trace import plain_trace
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Solid, trace
from task import VIRIDIS, colored
from torch import Tensor
from torch.nn.functional import batch_norm, conv2d, pad, relu6
from weights import load_encoder

from spackle.bases.lite import FEATURE_STAGES, STAGES, EfficientNetEncoder, EncoderSize
from spackle.runtime.errors import InputError

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it

Floats = NDArray[np.float32]


# Rays ---------------------------------------------------------------------------------------------


def random_solids(rng: np.random.Generator, count: int) -> list[Solid]:
    """Solids of every kind, rotated and stretched, some around the eye."""
    solids = []
    for number in range(count):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0] * rng.uniform(0.2, 1.0, 3)
        center = rng.uniform((-1, -1, 0.5), (1, 1, 4.0))
        kind = (SHEET, BOX, ELLIPSOID, CYLINDER)[number % 4]
        repeats = (float(rng.uniform(1, 3)), float(rng.uniform(1, 3)))
        solids.append(
            Solid(kind, f32(center), f32(axes), number % 3, repeats, casts=number % 5 > 0)
        )
    return solids


def rays_of(height: int, width: int) -> Floats:
    y, x = np.mgrid[:height, :width]
    flat = np.stack([(x + 0.5) / width - 0.5, (y + 0.5) / height - 0.5, np.full(x.shape, 0.8)], -1)
    return f32(flat / 0.8).reshape(-1, 3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rays_meet_what_their_plain_twin_meets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    textures = rng.random((3, 8, 8, 4)).astype(np.float32)
    textures[:2, :, :, 3] = 1
    light = f32([0.3, -0.8, -np.sqrt(1 - 0.09 - 0.64)])
    rays, solids = rays_of(20, 24), random_solids(rng, 8)
    sky = rng.random((len(rays), 3)).astype(np.float32)
    colors, distances = trace(solids, textures, rays, light, 0.4, sky)
    plain_colors, plain_distances = plain_trace(solids, textures, rays, light, 0.4, sky)
    # A ray along the outline of an object, cut-out or shadow may pass on either side.
    same = np.isclose(distances, plain_distances, rtol=1e-4)
    assert same.mean() > 0.99
    alike = np.abs(colors - plain_colors).max(-1) < 2e-3
    assert alike.mean() > 0.97
    missed = np.isinf(plain_distances)
    assert 0.02 < missed.mean() < 0.9
    assert (colors[missed & same] == sky[missed & same]).all()


def test_a_wall_has_the_depth_that_it_has_and_a_box_throws_a_shadow_on_it() -> None:
    textures = np.ones((1, 4, 4, 4), np.float32)
    wall = Solid(SHEET, f32([0, 0, 3]), f32(np.diag([2, 2, 1])), 0, (1.0, 1.0))
    box = Solid(BOX, f32([1, 0, 2]), f32(np.eye(3) / 4), 0, (1.0, 1.0))
    rays = f32([[-0.5, 0, 1], [0.5, 0.5, 1], [0.5, 0, 1], [0.9, 0, 1], [-0.25, 0, 1]])
    light = f32([0.6, 0.0, -0.8])  # from the right and from behind
    colors, distances = trace([wall, box], textures, rays, light, 0.5, np.zeros((5, 3), np.float32))
    assert distances.tolist() == pytest.approx([3, 3, 1.75, math.inf, 3])
    # The wall gets 0.8 of the light; the shadow of the box's middle is 0.75 to the left of it.
    assert colors[:, 0].tolist() == pytest.approx([0.9, 0.9, 0.9, 0, 0.9], abs=1e-6)
    shadow = f32([[0.25 / 3, 0, 1]])
    colors, _ = trace([wall, box], textures, shadow, light, 0.5, np.zeros((1, 3), np.float32))
    assert colors[0].tolist() == pytest.approx([0.5, 0.5, 0.5])


# A photo by other cameras -------------------------------------------------------------------------


def plane(height: int, width: int) -> Frame:
    """A frontal plane at depth 1, with a photo on it and a border of unknown depth."""
    rgb = torch.from_numpy(picture(width, height)).float().permute(2, 0, 1) / 255
    valid = torch.ones(height, width, dtype=torch.bool)
    valid[:, :2] = False
    return Frame(rgb, torch.ones(height, width), valid)


def test_a_camera_that_is_not_turned_sees_a_part_of_the_photo() -> None:
    still = Turning((1.0, 1.0), (0.0, 0.0, 0.0))
    frame = plane(48, 64)
    for seed in range(4):
        seen = turned(np.random.default_rng(seed), frame, 48, 64, still)
        rgb, valid = (
            (seen.rgb, seen.valid)
            if not seen.valid[24, 1]
            else (seen.rgb.flip(-1), seen.valid.flip(-1))
        )
        # As wide as the frame, but for the stretch across, at most a few pixels at the ends.
        assert float((rgb[:, :, 32] - frame.rgb[:, :, 32]).abs().mean()) < 0.02
        assert torch.equal(seen.inverse_depth[seen.valid].unique(), torch.tensor([1.0]))
        assert valid[:, 16:48].all()


def test_a_camera_turned_aside_sees_a_frontal_plane_aslant() -> None:
    """Its inverse depth is n·ray, with the plane's normal n in the new camera, |n| = 1: affine in
    the pixel.
    """
    seen = turned(
        np.random.default_rng(5), plane(48, 64), 48, 64, Turning((1.5, 1.5), (10.0, 10.0, 10.0))
    )
    rows, columns = (place.double() for place in seen.valid.nonzero(as_tuple=True))
    A = torch.stack([columns, rows, torch.ones_like(rows)], 1)
    fitted = torch.linalg.lstsq(A, seen.inverse_depth[seen.valid].double()[:, None]).solution[:, 0]
    torch.testing.assert_close(
        A @ fitted, seen.inverse_depth[seen.valid].double(), rtol=0, atol=1e-6
    )
    assert float(fitted[:2].norm()) > 1e-4
    assert float(seen.inverse_depth[seen.valid].max()) < 1.5


def test_other_light_changes_colours_and_keeps_them_colours() -> None:
    rgb = plane(48, 64).rgb
    for seed in range(5):
        changed = relit(np.random.default_rng(seed), rgb)
        assert changed.shape == rgb.shape
        assert 0 <= float(changed.min()) < float(changed.max()) <= 1
        assert float((changed - rgb).abs().mean()) > 0.005
        assert torch.equal(changed, relit(np.random.default_rng(seed), rgb))


# The loss -----------------------------------------------------------------------------------------


def terms(predicted: Tensor, truth: list[float], valid: list[bool]) -> dict[str, float]:
    loss, found = depth_loss(
        predicted[None, None],
        torch.tensor([[truth]]),
        torch.tensor([[valid]]),
        DepthLossWeights(factor=2.0, line=3.0, steps=0.5, offset=0.25),
    )
    numbers = {name: float(value) for name, value in found.items()}
    offset = numbers.pop("offset")
    total = 2 * numbers["factor"] + 3 * numbers["line"] + 0.5 * numbers["steps"] + 0.25 * offset
    assert float(loss) == pytest.approx(total)
    return numbers


def test_each_term_of_the_loss_is_what_it_says_it_is() -> None:
    """Inverse depths 1, 2, 4, 8 are ½, 1, 2, 4 medians; the third one's prediction is wrong by a
    factor of e^0.3.
    """
    truth, known = [1.0, 2.0, 4.0, 8.0], [True] * 4
    error = torch.tensor([0.0, 0.0, 0.3, 0.0])
    right = torch.tensor(truth).log() + 7  # whatever the factor
    found = terms(right + error, truth, known)
    assert found["factor"] == pytest.approx(0.3 / 4, rel=1e-5)
    # Neighbours: 0, 0.3, 0.3 over 4 pixels; every second pixel: 0.3 over 2; then only one pixel is
    # left.
    assert found["steps"] == pytest.approx(0.6 / 4 + 0.3 / 2, rel=1e-5)
    p, t = [0.5, 1.0, 2 * math.exp(0.3), 4.0], [0.5, 1.0, 2.0, 4.0]
    p, mean = [value - sum(p) / 4 for value in p], sum(t) / 4
    scale = sum(a * (b - mean) for a, b in zip(p, t, strict=True)) / (sum(a * a for a in p) + 4e-3)
    line = sum(abs(scale * a + mean - b) / (b + 0.2) for a, b in zip(p, t, strict=True)) / 4
    assert found["line"] == pytest.approx(line, rel=1e-4)
    assert terms(right, truth, known) == pytest.approx(
        {"factor": 0, "line": 0, "steps": 0}, abs=1e-3
    )


def test_only_the_offset_knows_a_factor_and_pulls_it_back() -> None:
    """Medians are over known pixels; one picture is too near by e^3, and in the third nothing is
    known.
    """
    truth = torch.tensor([[[1.0, 2.0, 4.0]]]).expand(3, 1, 3)
    valid = torch.tensor([True, True, False])[:, None, None].expand(3, 1, 3)
    predicted = (truth.log() + torch.tensor([3.0, 0.0, 9.0])[:, None, None]).requires_grad_()
    loss, found = depth_loss(predicted, truth, valid, DepthLossWeights(offset=0.6))
    # t is over its median, 2
    assert float(found["offset"]) == pytest.approx((3 + 2 * math.log(2)) / 3)
    assert loss.item() == pytest.approx(0.6 * float(found["offset"]), abs=2e-3)
    (gradient,) = torch.autograd.grad(loss, predicted)
    assert gradient.sum((1, 2)).tolist() == pytest.approx([0.2, 0.2, 0], abs=1e-3)


def test_steps_are_compared_at_four_distances() -> None:
    found = terms(torch.tensor([0.0] * 8 + [0.3]), [1.0] * 9, [True] * 9)
    assert found["steps"] == pytest.approx(0.3 / 9 + 0.3 / 5 + 0.3 / 3 + 0.3 / 2)


def test_what_is_not_known_does_not_count_and_gross_errors_count_as_less() -> None:
    truth = [1.0, 2.0, 4.0, 8.0, 0.0, 1e9]
    known = [True, True, True, True, False, False]
    right = torch.tensor([1.0, 2.0, 4.0, 8.0, 0.01, 700.0]).log()
    assert terms(right, truth, known) == pytest.approx(
        {"factor": 0, "line": 0, "steps": 0}, abs=1e-3
    )
    found = terms(right + torch.tensor([0.0, 0.0, 0.0, -5.0, 0.0, 0.0]), truth, known)
    assert found["factor"] == pytest.approx(2 / 4)
    assert found["steps"] == pytest.approx(1 / 4)  # strides 2 and 4 skip it
    assert terms(right, truth, [False] * 6) == {"factor": 0, "line": 0, "steps": 0}


def test_the_sky_is_far_and_that_is_all_that_is_known_of_it() -> None:
    found = [
        terms(torch.tensor([0.0, 0.0, 0.0, sky]), [1.0, 1.0, 1.0, 0.0], [True] * 4)
        for sky in (0.0, -3.9, -9.0)
    ]
    assert found[1]["factor"] == pytest.approx((math.log(50) - 3.9) / 4, abs=1e-6)
    assert found[0]["factor"] == pytest.approx(2 / 4) == found[2]["factor"]


def test_a_shift_in_inverse_depth_costs_the_term_that_knows_of_factors_alone() -> None:
    truth = [1.0, 2.0, 4.0, 8.0]
    found = terms((torch.tensor(truth) + 3).log(), truth, [True] * 4)
    assert found["line"] < 1e-2 < 0.1 < found["factor"]


# The score ----------------------------------------------------------------------------------------


def test_a_score_knows_neither_scale_nor_shift() -> None:
    depth = torch.linspace(1, 5, 60).reshape(6, 10)
    valid = depth < 4.5
    for guess in (1 / depth, 7 / depth + 3, 0.01 / depth - 2):
        score = score_depth(guess.where(valid, -1e6), depth, valid)
        assert score.abs_rel == pytest.approx(0, abs=1e-5)
        assert score.delta == 1


def test_what_is_farther_than_ten_medians_does_not_count() -> None:
    depth = torch.tensor([[1.0, 2.0, 3.0, 2.0, 29.0]])  # the median is 2: 20 and more do not count
    valid = torch.ones(1, 5, dtype=torch.bool)
    guess = 1 / depth
    guess[0, 4] = 1.0  # as near as the nearest
    assert score_depth(guess, depth, valid).abs_rel == pytest.approx(0, abs=1e-6)
    depth[0, 4] = 19.0
    assert score_depth(guess, depth, valid).abs_rel > 0.1


def test_a_score_by_hand() -> None:
    """Half is at 1 m, half at 2 m: a constant guess is aligned to 4/3 m."""
    depth = torch.tensor([[1.0, 1.0], [2.0, 2.0]])
    score = score_depth(torch.full((2, 2), 0.3), depth, torch.ones(2, 2, dtype=torch.bool))
    assert score.abs_rel == pytest.approx(1 / 3)
    assert score.delta == 0
    assert score_depth(vertical_ramp(2, 2), 3 - depth, depth > 0).abs_rel == pytest.approx(
        0, abs=1e-6
    )


def test_what_would_lie_behind_the_eye_is_put_far_away() -> None:
    depth = torch.tensor([[1.0, 1.0, 1.0, 10.0]])
    score = score_depth(
        torch.tensor([[1.0, 0.9, 1.1, -9.0]]), depth, torch.ones(1, 4, dtype=torch.bool)
    )
    assert score.abs_rel < 0.5


def test_near_is_light_and_unknown_is_grey() -> None:
    values = torch.tensor([[0.0, 1.0, 2.0, 1.0]])
    shown = colored(values, 0.0, 2.0, torch.tensor([[True, True, True, False]]))
    assert torch.equal(shown[0, :3], VIRIDIS[[0, 4, 8]])
    assert len(shown[0, 3].unique()) == 1
    luminance = colored(torch.linspace(0, 1, 50)[None], 0.0, 1.0) @ torch.tensor(
        [0.2126, 0.7152, 0.0722]
    )
    assert (luminance.diff() > 0).all()


# The encoder's first weights ----------------------------------------------------------------------


def published(rng: torch.Generator, size: EncoderSize) -> dict[str, Tensor]:
    """Random tensors with the names in EfficientNet-Lite's conversions to PyTorch."""
    tensors: dict[str, Tensor] = {}

    def layer(convolution: str, norm: str, shape: torch.Size) -> None:
        fan = shape[1] * shape[2] * shape[3]
        tensors[f"{convolution}.weight"] = torch.randn(shape, generator=rng) * (2 / fan) ** 0.5
        for name, low, high in (
            ("weight", 0.5, 1.5),
            ("bias", -0.2, 0.5),
            ("running_mean", -0.2, 0.2),
        ):
            tensors[f"{norm}.{name}"] = low + (high - low) * torch.rand(shape[0], generator=rng)
        tensors[f"{norm}.running_var"] = 0.5 + torch.rand(shape[0], generator=rng)

    shapes = {
        name: tensor.shape
        for name, tensor in EfficientNetEncoder(size).state_dict().items()
        if name.endswith("weight")
    }
    layer("_conv_stem", "_bn0", shapes["stem.weight"])
    places = [
        (stage, block) for stage, (count, *_) in enumerate(STAGES[size]) for block in range(count)
    ]
    for number, (stage, block) in enumerate(places):
        ours, theirs = f"stages.{stage}.{block}", f"_blocks.{number}"
        for part, norm in (("expand", "_bn0"), ("depthwise", "_bn1"), ("project", "_bn2")):
            if f"{ours}.{part}.weight" in shapes:
                layer(f"{theirs}._{part}_conv", f"{theirs}.{norm}", shapes[f"{ours}.{part}.weight"])
    return tensors | {"_fc.weight": torch.zeros(10, 1280)}


def plain_features(tensors: dict[str, Tensor], x: Tensor, size: EncoderSize) -> list[Tensor]:
    """EfficientNet-Lite layer by layer, with separate convolution and normalisation, and
    TensorFlow's padding.
    """

    def layer(x: Tensor, convolution: str, norm: str, stride: int = 1, groups: int = 1) -> Tensor:
        weight = tensors[f"{convolution}.weight"]
        kernel, side = weight.shape[-1], x.shape[-1]
        missing = max(0, (-(-side // stride) - 1) * stride + kernel - side)
        x = conv2d(
            pad(x, (missing // 2, missing - missing // 2) * 2), weight, stride=stride, groups=groups
        )
        mean, var, gain, bias = (
            tensors[f"{norm}.{n}"] for n in ("running_mean", "running_var", "weight", "bias")
        )
        return batch_norm(x, mean, var, gain, bias, eps=1e-3)

    x = relu6(layer((x * 255 - 127) / 128, "_conv_stem", "_bn0", 2))
    number, features = 0, []
    for stage, (count, _, stride, expansion, _) in enumerate(STAGES[size]):
        for block in range(count):
            name, y = f"_blocks.{number}", x
            if expansion > 1:
                y = relu6(layer(y, f"{name}._expand_conv", f"{name}._bn0"))
            step = stride if block == 0 else 1
            y = relu6(layer(y, f"{name}._depthwise_conv", f"{name}._bn1", step, y.shape[1]))
            y = layer(y, f"{name}._project_conv", f"{name}._bn2")
            x = x + y if x.shape == y.shape else y
            number += 1
        if stage in FEATURE_STAGES:
            features.append(x)
    return features


@pytest.mark.parametrize("size", ["lite0", "lite2"])
def test_folded_weights_do_what_convolutions_and_normalisations_did(
    tmp_path: Path, size: EncoderSize
) -> None:
    rng = torch.Generator().manual_seed(0)
    tensors = published(rng, size)
    torch.save(tensors, tmp_path / "published.pth")
    photos = torch.rand(1, 3, 64, 64, generator=rng)
    with torch.no_grad():
        for mine, plain in zip(
            load_encoder(size, tmp_path / "published.pth")(photos),
            plain_features(tensors, photos, size),
            strict=True,
        ):
            torch.testing.assert_close(mine, plain, rtol=1e-3, atol=1e-3 * float(plain.std()))


@pytest.mark.parametrize(
    "content", [b"", b"nothing", {"_conv_stem.weight": torch.zeros(1)}, [1, 2], torch.zeros(3)]
)
def test_a_file_that_is_no_efficientnet_is_refused(tmp_path: Path, content: object) -> None:
    path = tmp_path / "other.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(
        InputError, match=r"other\.pth: no weights of EfficientNet-Lite2 for PyTorch: give encoder="
    ):
        load_encoder("lite2", path)
