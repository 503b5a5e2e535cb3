"""The four terms of eq. 12, and two measures of how well a hole was filled.

Arguments of the terms: `rgb` [B, H, W, 3] sRGB 0..1 and `alpha` [B, H, W] of completed views, the
base's view `base_rgb` [B, H, W, 3], the `target` [B, H, W, 3], the `hole` [B, H, W] bool: pixels
that the photo does not show. A term averages over an image's pixels inside or outside of the hole,
then over images. An image without such pixels counts as a differentiable 0.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from spackle.core.filters import gaussian_blur, maximum_filter
from spackle.paper.training.feature_networks import FeatureNet
from spackle.paper.training.recipe import LossRecipe

# The renderer draws no alpha below 1/255, so this floor takes no gradient from a visible Gaussian.
MIN_ALPHA = 1e-3
MIN_FEATURE_LENGTH = 1e-10  # least divisor of feature vectors, as in LPIPS
MIN_DIVISOR = 1e-6  # avoids division by zero


def color_loss(rgb: Tensor, target: Tensor, hole: Tensor, blur: float = 0.0) -> Tensor:
    """The mean |rgb - target| over the pixels of a hole and the channels, then over images.

    The result is a scalar tensor.

    Args:
        rgb: completed views [B, H, W, 3], sRGB 0..1.
        target: what they should look like [B, H, W, 3].
        hole: [B, H, W] bool.
        blur: if above 0, a Gaussian with this standard deviation in pixels first blurs the
            difference within the hole. The perceptual term alone then determines texture.
    """
    difference = torch.where(hole[..., None], rgb - target, 0)
    if blur > 0:
        # Dividing by the blurred hole gives weights that add up to 1 within the hole.
        weight_sums = gaussian_blur(hole[..., None].to(rgb), blur).clamp_min(MIN_DIVISOR)
        blurred_difference = gaussian_blur(difference, blur) / weight_sums
        difference = torch.where(hole[..., None], blurred_difference, 0)
    return mean_of_images(difference.abs().mean(-1), hole)


def alpha_loss(alpha: Tensor, hole: Tensor) -> Tensor:
    """The mean -log(max(alpha, 0.001)) over a hole, a scalar: cross entropy towards opacity 1."""
    hole_alpha = torch.where(hole, alpha, 1).clamp_min(MIN_ALPHA)
    return mean_of_images(-hole_alpha.log(), hole)


def preserve_loss(rgb: Tensor, base_rgb: Tensor, hole: Tensor) -> Tensor:
    """The mean |rgb - base_rgb| over the pixels outside of the hole and the channels, a scalar.

    Completed views [B, H, W, 3] should not change there. `base_rgb`, the views before completion,
    gets no gradient; `hole` is [B, H, W] bool.
    """
    return color_loss(rgb, base_rgb.detach(), ~hole)


def perceptual_loss(
    features: FeatureNet,
    rgb: Tensor,
    target: Tensor,
    hole: Tensor,
    *,
    dilation: int = 21,
    size: int | None = 512,
    gram: float = 1.0,
) -> Tensor:
    """How much features and textures near the hole differ from the target's, a scalar tensor.

    Features are the outputs of some layers of a network for images; Gram matrices of features
    describe texture. The differences of both are summed over the layers.

    F and T are a layer's features [C, h, w] of prediction and target, divided by the root mean
    square of T. The weight w [h, w] is the fraction of each cell of the feature map that the
    dilated hole covers. A layer adds

        sum(w |F - T|) / (C sum(w))  +  gram · mean |G(F) - G(T)|,

    with the Gram matrix G(F) = (F w) F^T / sum(w), [C, C].

    Args:
        features: the network.
        rgb: completed views [B, H, W, 3], sRGB 0..1. Outside of the dilated hole they count as
            equal to the target.
        target: what they should look like [B, H, W, 3].
        hole: [B, H, W] bool.
        dilation: side in pixels of the square by which the hole is extended.
        size: longer side in pixels to which images are resized for the network; None: not resized.
        gram: weight of the Gram matrices.
    """
    near_hole = maximum_filter(hole, dilation // 2)  # [B, H, W] bool
    # Without a hole the network need not run. On a GPU, reading the mask would wait for the GPU.
    if near_hole.device.type == "cpu" and not near_hole.any():
        return rgb[:0].sum()  # 0, and a gradient of zeros

    prediction = torch.where(near_hole[..., None], rgb, target)
    prediction_maps = features(resize_for_network(prediction, size))
    with torch.no_grad():
        target_maps = features(resize_for_network(target, size))

    layer_losses = []
    for prediction_map, target_map in zip(prediction_maps, target_maps, strict=True):
        weight = covered_fraction(near_hole, prediction_map)
        feature_term, gram_term = layer_terms(prediction_map, target_map, weight)
        layer_losses.append(feature_term + gram * gram_term)
    return torch.stack(layer_losses).sum()


def total_loss(
    rgb: Tensor,
    alpha: Tensor,
    target: Tensor,
    base_rgb: Tensor,
    hole: Tensor,
    recipe: LossRecipe,
    features: FeatureNet | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss, a weighted sum of terms, and the terms by name, without weights and gradients.

    All of them are scalar tensors, of shape []. This is eq. 12 of the paper.

    Args:
        rgb: completed views [B, H, W, 3], sRGB 0..1.
        alpha: their opacity [B, H, W].
        target: what they should look like [B, H, W, 3].
        base_rgb: the views before completion [B, H, W, 3].
        hole: [B, H, W] bool, what completion fills.
        recipe: weights of the terms, and their settings.
        features: the network of the perceptual term; None: the sum has no perceptual term.
    """
    terms = {
        "color": color_loss(rgb, target, hole, recipe.color_blur),
        "alpha": alpha_loss(alpha, hole),
        "preserve": preserve_loss(rgb, base_rgb, hole),
    }
    if features is not None:
        terms["perceptual"] = perceptual_loss(
            features,
            rgb,
            target,
            hole,
            dilation=recipe.dilation,
            size=recipe.feature_size,
            gram=recipe.gram,
        )

    # The recipe has the weight of each term under the name of the term.
    weighted_terms = [getattr(recipe, name) * term for name, term in terms.items()]
    detached_terms = {name: term.detach() for name, term in terms.items()}
    return torch.stack(weighted_terms).sum(), detached_terms


@torch.no_grad()
def hole_distance(features: FeatureNet, rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """Perceptual distance inside a hole; 0 for equal images, NaN for an empty hole.

    It is LPIPS without learned weights.

    Feature vectors are scaled to unit length. Their squared difference is averaged over a layer's
    cells, weighted by the fraction of each cell that the hole covers, and summed over layers. Only
    distances by the same network are comparable. `rgb` and `target` are [H, W, 3] sRGB 0..1, `hole`
    is [H, W] bool.
    """
    if not hole.any():
        return math.nan

    # Outside of the hole both images are the target, so that only the hole makes a difference.
    prediction = torch.where(hole[..., None], rgb, target)
    images = torch.stack([prediction, target]).movedim(-1, 1)  # [2, 3, H, W]
    total = 0.0
    for feature_map in features(images):  # [2, C, h, w]
        lengths = feature_map.norm(dim=1, keepdim=True).clamp_min(MIN_FEATURE_LENGTH)
        prediction_unit, target_unit = feature_map / lengths
        squared_distance = (prediction_unit - target_unit).square().sum(0)  # [h, w]
        weight = covered_fraction(hole[None], feature_map)[0, 0]  # [h, w]
        total += float((squared_distance * weight).sum() / weight.sum())
    return total


def hole_psnr(rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """PSNR in dB over a hole's pixels; infinite for equal images, NaN for an empty hole.

    `rgb` and `target` are [H, W, 3] sRGB 0..1, `hole` is [H, W] bool.
    """
    if not hole.any():
        return math.nan
    mean_squared_error = float((rgb - target)[hole].double().square().mean())
    if mean_squared_error == 0:
        return math.inf
    return -10 * math.log10(mean_squared_error)


def covered_fraction(mask: Tensor, features: Tensor) -> Tensor:
    """The fraction [B, 1, h, w] of each cell of a feature map that a mask covers.

    `mask` is [B, H, W] bool, `features` [B, C, h, w].
    """
    height, width = features.shape[-2:]
    return F.adaptive_avg_pool2d(mask[:, None].to(features.dtype), (height, width))


def mean_of_images(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of values [B, H, W] over the mask [B, H, W] of each image, then over images.

    The values must be 0 outside of the mask. An image with an empty mask counts as 0.
    """
    pixel_counts = mask.sum((1, 2)).clamp_min(1)  # [B]
    return (values.sum((1, 2)) / pixel_counts).mean()


def resize_for_network(images: Tensor, size: int | None) -> Tensor:
    """Images [B, H, W, 3] as [B, 3, h, w], with a longer side of `size` pixels.

    None keeps the size.
    """
    images = images.movedim(-1, 1)  # [B, 3, H, W]
    height, width = images.shape[-2:]
    if size is None or size == max(height, width):
        return images
    scale = size / max(height, width)
    new_size = (max(1, round(height * scale)), max(1, round(width * scale)))
    return F.interpolate(images, new_size, mode="bilinear", antialias=True, align_corners=False)


def layer_terms(prediction: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The feature term and the Gram term of the perceptual loss for one layer, two scalars.

    Both compare features of prediction and target [B, C, h, w], weighted by cell, with weights
    [B, 1, h, w]. The feature term is the mean difference; the Gram term is the mean difference of
    the Gram matrices, which describe textures.
    """
    # Layers have features of different sizes; divided by the target's root mean square, all layers
    # count alike.
    mean_square = target.square().mean(dim=(1, 2, 3), keepdim=True)
    root_mean_square = (mean_square + MIN_DIVISOR**2).sqrt()  # [B, 1, 1, 1]
    prediction = prediction / root_mean_square
    target = target / root_mean_square

    area = weight.sum(dim=(1, 2, 3))  # [B], 0 without a hole
    weighted_difference = (weight * (prediction - target).abs()).mean(1)  # [B, h, w]
    feature_terms = weighted_difference.sum((1, 2)) / area.clamp_min(MIN_DIVISOR)
    gram_difference = gram_matrix(prediction, weight, area) - gram_matrix(target, weight, area)
    gram_terms = gram_difference.abs().mean((1, 2))
    return feature_terms.mean(), gram_terms.mean()


def gram_matrix(features: Tensor, weight: Tensor, area: Tensor) -> Tensor:
    """The Gram matrices [B, C, C] of features [B, C, h, w]: G = (F w) F^T / area.

    Args:
        features: F, whose cells h · w are the columns of a matrix.
        weight: w, the weights of the cells [B, 1, h, w].
        area: the sum of the weights [B].
    """
    products = (features * weight).flatten(2) @ features.flatten(2).mT
    return products / area.clamp_min(MIN_DIVISOR)[:, None, None]
