"""Losses and distances against hand-computed numbers, and the feature networks."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from spackle.paper.training.feature_networks import ResNet50, SqueezeNet, load_features
from spackle.paper.training.losses import (
    alpha_loss,
    color_loss,
    hole_distance,
    hole_psnr,
    perceptual_loss,
    preserve_loss,
    total_loss,
)
from spackle.paper.training.recipe import LossRecipe
from spackle.runtime.errors import InputError

RGB = torch.tensor([[[[0.1, 0.2, 0.3], [0.5, 0.5, 0.5]]]])  # [1, 1, 2, 3]: one row of two pixels
TARGET = torch.tensor([[[[0.2, 0.2, 0.0], [1.0, 0.0, 0.9]]]])
LEFT = torch.tensor([[[True, False]]])
NO_HOLE = torch.zeros_like(LEFT)
PAPER = LossRecipe()


class Pixels:
    """Features: the image times each factor."""

    name = "pixels"

    def __init__(self, *factors: float) -> None:
        self.factors = factors

    def __call__(self, images: Tensor) -> list[Tensor]:
        return [factor * images for factor in self.factors]


def pictures(*shape: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    values = torch.rand(
        2, *shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.double
    )
    return values[0].requires_grad_(), values[1]


def grad(tensor: Tensor) -> Tensor:
    assert tensor.grad is not None
    return tensor.grad


def test_color_is_the_mean_difference_in_each_images_hole() -> None:
    hole = torch.tensor([[[True, False]], [[True, True]], [[False, False]]])
    expected = (0.4 / 3 + (0.1 + 0.0 + 0.3 + 0.5 + 0.5 + 0.4) / 6 + 0) / 3
    assert color_loss(
        RGB.expand(3, -1, -1, -1), TARGET.expand(3, -1, -1, -1), hole
    ).item() == pytest.approx(expected)


def test_a_blurred_color_loss_averages_within_the_hole() -> None:
    rgb, target = pictures(2, 7, 9)
    hole, sigma = torch.rand(2, 7, 9, generator=torch.Generator().manual_seed(4)) < 0.5, 1.2
    each = []
    for one, other, mask in zip(rgb.detach(), target, hole, strict=True):
        cells = mask.nonzero()
        apart, far = (one - other)[mask], (cells[:, None] - cells).double()
        weights = torch.exp(-far.square().sum(-1) / (2 * sigma**2)) * (
            far.abs().amax(-1) <= math.ceil(3 * sigma)
        )
        each.append(float((weights @ apart / weights.sum(1, keepdim=True)).abs().mean()))
    assert color_loss(rgb, target, hole, sigma).item() == pytest.approx(sum(each) / 2, rel=1e-5)


def test_alpha_is_clamped_cross_entropy_towards_one() -> None:
    alpha, hole = (
        torch.tensor([[[0.5, 0.9]], [[0.25, 0.25]]]),
        torch.tensor([[[True, False]], [[True, True]]]),
    )
    assert alpha_loss(alpha, hole).item() == pytest.approx((0.693147 + 1.386294) / 2)
    alpha = torch.tensor([[[0.0, 1 / 255]]], requires_grad=True)  # a faint splat has a gradient
    loss = alpha_loss(alpha, ~NO_HOLE)
    loss.backward()
    assert loss.item() == pytest.approx((6.907755 + 5.541264) / 2)  # -log 0.001 and -log(1/255)
    assert grad(alpha).flatten().tolist() == pytest.approx([0, -255 / 2])


def test_preserve_is_the_mean_difference_outside_of_the_hole() -> None:
    rgb, base = RGB.clone().requires_grad_(), TARGET.clone().requires_grad_()
    loss = preserve_loss(rgb, base, LEFT)
    loss.backward()
    assert loss.item() == pytest.approx((0.5 + 0.5 + 0.4) / 3)
    assert base.grad is None
    assert grad(rgb).flatten().tolist() == pytest.approx([0, 0, 0, -1 / 3, 1 / 3, -1 / 3])
    assert preserve_loss(RGB, TARGET, ~NO_HOLE).item() == 0


# Mean square of the target 3/6; left pixels (0, 0.5, 0) and (1, 0, 0).
FOUND, WANTED = (
    torch.tensor([[[[0.0, 0.5, 0], [9, 9, 9]]]]),
    torch.tensor([[[[1.0, 0, 0], [0, 1, 1]]]]),
)
FEATURE_TERM = (1 + 0.5 + 0) / math.sqrt(0.5) / 3
GRAM_TERM = (
    1 / 0.5 + 0.25 / 0.5
) / 9  # entries (0, 0) of the target and (1, 1) of the prediction, of nine


@pytest.mark.parametrize("gram", [1.0, 0.25, 0.0])
@pytest.mark.parametrize("factors", [(1,), (1, 100, 0.01)])
def test_perceptual_sums_feature_and_gram_terms_of_layers(
    factors: tuple[float, ...], gram: float
) -> None:
    expected = len(factors) * (FEATURE_TERM + gram * GRAM_TERM)
    both = (tensor.repeat(2, 1, 1, 1) for tensor in (FOUND, WANTED))
    loss = perceptual_loss(
        Pixels(*factors), *both, torch.cat([LEFT, NO_HOLE]), dilation=1, size=None, gram=gram
    )
    assert loss.item() == pytest.approx(expected / 2, rel=1e-5)


@pytest.mark.parametrize(("size", "seen"), [(4, (3, 4)), (16, (12, 16)), (None, (6, 8))])
def test_perceptual_resizes_and_compares_only_near_the_hole(
    size: int | None, seen: tuple[int, int]
) -> None:
    sizes = []

    class Watching(Pixels):
        def __call__(self, images: Tensor) -> list[Tensor]:
            sizes.append(tuple(images.shape))
            return super().__call__(images)

    rgb, target = pictures(1, 6, 8)
    hole = torch.zeros(1, 6, 8, dtype=torch.bool)
    hole[..., 3] = True
    perceptual_loss(Watching(1), rgb, target, hole, dilation=5, size=size).backward()
    assert sizes == [(1, 3, *seen)] * 2
    assert grad(rgb).abs().sum((0, 1, 3)).bool().tolist() == [False] + 5 * [True] + 2 * [False]
    assert perceptual_loss(Pixels(1), target, target, hole, size=size).item() == 0


def test_without_a_hole_there_is_nothing_to_fill() -> None:
    rgb, alpha = RGB.clone().requires_grad_(), torch.tensor([[[0.0, 0.5]]], requires_grad=True)
    loss, terms = total_loss(rgb, alpha, TARGET, RGB, NO_HOLE, recipe=PAPER, features=Pixels(1))
    loss.backward()
    assert terms == {"color": 0, "alpha": 0, "preserve": 0, "perceptual": 0}
    assert not grad(rgb).any()
    assert not grad(alpha).any()
    assert math.isnan(hole_psnr(RGB[0], TARGET[0], NO_HOLE[0]))
    assert math.isnan(hole_distance(Pixels(1), RGB[0], TARGET[0], NO_HOLE[0]))


def test_the_total_is_the_weighted_sum_of_its_terms() -> None:
    images = FOUND, torch.tensor([[[0.5, 0.0]]]), WANTED, torch.full_like(FOUND, 8.75), LEFT
    loss, terms = total_loss(
        *images, PAPER.model_copy(update={"dilation": 1, "feature_size": None}), Pixels(1)
    )
    values = {
        "color": 0.5,
        "alpha": 0.693147,
        "perceptual": FEATURE_TERM + GRAM_TERM,
        "preserve": 0.25,
    }
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(values, rel=1e-5)
    assert loss.item() == pytest.approx(
        sum(getattr(PAPER, name) * value for name, value in values.items()), rel=1e-5
    )
    assert set(total_loss(*images, PAPER)[1]) == {"color", "alpha", "preserve"}


def test_distance_is_between_directions_and_psnr_of_the_hole() -> None:
    target = torch.tensor([[[1.0, 0, 0], [0, 0, 1]]])

    def distance(*pixel: float) -> float:
        return hole_distance(Pixels(1, 5), torch.tensor([[pixel, (9.0, 9, 9)]]), target, LEFT[0])

    assert distance(0, 1, 0) == pytest.approx(2 * 2)  # a right angle in each of the two layers
    assert distance(1, 1, 0) == pytest.approx(2 * (2 - math.sqrt(2)))
    assert distance(0.5, 0, 0) == 0  # the same direction
    assert distance(0, 0, 0) == pytest.approx(2 * 1)  # no direction at all
    assert hole_psnr(RGB[0], TARGET[0], LEFT[0]) == pytest.approx(
        -10 * math.log10((0.01 + 0.09) / 3)
    )
    assert hole_psnr(RGB[0], RGB[0], LEFT[0]) == math.inf


def test_distance_weighs_cells_by_their_share_of_the_hole() -> None:
    target = torch.zeros(2, 4, 3, dtype=torch.double)
    target[..., 0], rgb = 1, torch.zeros(2, 4, 3, dtype=torch.double)
    rgb[:, :2, 1], rgb[:, 2:, 0] = 1, 1  # wrong in the left half, right in the right one
    hole = torch.tensor([[True, True, True, False], [True, False, False, False]])

    class Halved(Pixels):
        def __call__(self, images: Tensor) -> list[Tensor]:
            return [F.max_pool2d(images, 2)]

    # The hole covers 3/4 of the left cell, which is wrong, and 1/4 of the right cell, which is
    # right.
    assert hole_distance(Halved(), rgb, target, hole) == pytest.approx(0.75 * (2 - math.sqrt(2)))


# Feature networks ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def resnet() -> dict[str, Tensor]:
    """Random weights and statistics, and a classifier."""
    torch.manual_seed(0)
    state = dict(ResNet50().state_dict())
    for name, value in state.items():
        if name.endswith("running_var"):
            value.uniform_(0.5, 2)
    return state | {"fc.weight": torch.randn(1000, 2048), "fc.bias": torch.randn(1000)}


@pytest.fixture
def squeezed() -> dict[str, np.ndarray]:
    """Random weights with Caffe's names."""
    rng = np.random.default_rng(0)
    shapes = {"conv1": (96, 3, 7, 7), "conv10": (1000, 512, 1, 1)}
    # Input, squeezed and expanded channels of fire2 to fire9 (table 1 of SqueezeNet's paper).
    fires = [
        (96, 16, 64),
        (128, 16, 64),
        (128, 32, 128),
        (256, 32, 128),
        (256, 48, 192),
        (384, 48, 192),
    ]
    for number, (inside, squeeze, expand) in enumerate([*fires, (384, 64, 256), (512, 64, 256)], 2):
        shapes[f"fire{number}/conv1x1_1"] = (squeeze, inside, 1, 1)
        shapes |= {f"fire{number}/conv{k}x{k}_2": (expand, squeeze, k, k) for k in (1, 3)}
    arrays = {}
    for name, shape in shapes.items():
        fan = np.prod(shape[1:])
        arrays[f"{name}.w"] = (rng.standard_normal(shape) * np.sqrt(2 / fan)).astype(np.float32)
        arrays[f"{name}.b"] = rng.standard_normal(shape[0]).astype(np.float32)
    return arrays


def test_resnet_has_torchvisions_names_shapes_and_input(
    resnet: dict[str, Tensor], tmp_path: Path
) -> None:
    path = tmp_path / "resnet.pth"
    torch.save(resnet, path)
    network = load_features("resnet50", path)
    assert isinstance(network, ResNet50)
    assert all(torch.equal(value, resnet[name]) for name, value in network.state_dict().items())
    # torchvision's network without the classifier
    assert (
        sum(parameter.numel() for parameter in network.parameters())
        == 25_557_032 - 2048 * 1000 - 1000
    )
    assert len(network.state_dict()) == 320 - 2
    assert resnet["layer3.5.bn3.running_var"].shape == (1024,)
    seen: list[Tensor] = []
    network.conv1.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    network(torch.tensor([0.485, 0.456 + 0.224, 0.0]).view(1, 3, 1, 1).expand(1, 3, 32, 32))
    assert seen[0][0, :, 0, 0].tolist() == pytest.approx([0, 1, -0.406 / 0.225], abs=1e-6)
    maps = network(torch.rand(1, 3, 64, 96))
    assert [tuple(m.shape) for m in maps] == [
        (1, 256, 16, 24),
        (1, 512, 8, 12),
        (1, 1024, 4, 6),
        (1, 2048, 2, 3),
    ]


def test_squeezenet_has_caffes_sizes_and_input(
    squeezed: dict[str, np.ndarray], tmp_path: Path
) -> None:
    np.savez(tmp_path / "squeeze.npz", **squeezed)
    squeezenet = load_features("squeezenet", tmp_path / "squeeze.npz")
    assert isinstance(squeezenet, SqueezeNet)
    shapes = [tuple(m.shape[1:]) for m in squeezenet(torch.rand(1, 3, 227, 227))]
    assert shapes == [
        (96, 111, 111),
        (256, 55, 55),
        (512, 27, 27),
        (512, 13, 13),
    ]  # table 1, with 227 in place of 224
    image = torch.rand(3, 48, 48, generator=torch.Generator().manual_seed(2))
    bgr = 255 * image.numpy()[::-1] - np.array([104, 117, 123])[:, None, None]
    window = bgr[:, 2 * 4 : 2 * 4 + 7, 2 * 9 : 2 * 9 + 7]
    cell = np.maximum((squeezed["conv1.w"] * window).sum((1, 2, 3)) + squeezed["conv1.b"], 0)
    np.testing.assert_allclose(
        squeezenet(image[None])[0][0, :, 4, 9].numpy(), cell, rtol=1e-4, atol=1e-3
    )


def test_files_of_other_networks_are_refused(
    squeezed: dict[str, np.ndarray], tmp_path: Path
) -> None:
    def refused(name: Any, path: Path | None, said: str) -> None:
        with pytest.raises(
            InputError, match=rf"(?=.*{re.escape(said)})(?=.*{re.escape(str(path or ''))})"
        ):
            load_features(name, path)

    assert load_features("none", None) is None
    refused("resnet50", None, "loss.features_path: missing")
    refused("squeezenet", tmp_path / "missing.npz", "no such weight file")
    for change, said in (
        ({"conv1.w": squeezed["conv1.w"][:, :, :3, :3]}, "1 of another shape (conv1.weight"),
        (
            {"conv1.w": np.array([{}])},
            "not a file of weights",
        ),  # an object would have to be unpickled
    ):
        np.savez(tmp_path / "other.npz", **(squeezed | change))
        refused("squeezenet", tmp_path / "other.npz", said)
