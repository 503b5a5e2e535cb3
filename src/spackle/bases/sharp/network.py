"""SHARP (Apple, 2025): one picture to two layers of Gaussians. Modules are named as in its checkpoint."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d, softplus

from spackle.bases.protocol import Progress
from spackle.bases.sharp.layers import (
    LAYERS,
    STRIDE,
    Decoder,
    ExactConv,
    Fusion,
    SharpConfig,
    SlidingPyramid,
    normed_residual,
)
from spackle.color import srgb_to_linear
from spackle.gaussians import Gaussians

DISPARITY_RANGE = (1e-4, 1e4)  # what the depth head says is clamped to it
HIDDEN = 32  # channels before the last layer of the depth head


@dataclasses.dataclass(frozen=True)
class SharpOutput:
    """What the network says about one picture."""

    start: InitialGaussians  # Gaussians on the two surfaces
    deltas: Tensor  # [14, 2, side/2, side/2] float32, to be applied to them


@dataclasses.dataclass(frozen=True)
class Seen:
    """What encoder and depth network make of one picture: all that the Gaussian decoder goes by."""

    start: InitialGaussians
    picture: Tensor  # [1, 5, side, side] float32 in -1..1: sRGB, and the disparity of both layers
    maps: list[Tensor]  # the encoder's, fine to coarse: [1, C, side/2, side/2] to [1, C, side/32, side/32]


class SharpNetwork(nn.Module):
    """The whole network but for what inference never uses (see `unused_shapes`)."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.config = config
        self.monodepth_model = nn.Module()
        self.monodepth_model.monodepth_predictor = DepthNetwork(config)
        self.feature_model = FeatureNetwork(config)
        self.prediction_head = PredictionHead(config.feature_width)

    def forward(
        self, image: Tensor, disparity_factor: float | Tensor, batch: int, progress: Progress | None = None
    ) -> SharpOutput:
        """Predict from the photo, stretched to [1, 3, side, side] sRGB in 0..1, float32.

        `disparity_factor` is the focal length over the width in the photo's pixels. So many windows as `batch` says go
        through the transformer at once; `progress` gets the windows done and the number of all.
        """
        seen = self.see(image, disparity_factor, batch, progress)
        deltas: Tensor = self.gaussian_decoder()(seen.picture, seen.maps)
        return SharpOutput(seen.start, deltas)

    def see(
        self, image: Tensor, disparity_factor: float | Tensor, batch: int, progress: Progress | None = None
    ) -> Seen:
        """Everything before the Gaussian decoder; the arguments are `forward`'s."""
        depth_network: DepthNetwork = self.monodepth_model.monodepth_predictor  # type: ignore[assignment]
        maps = depth_network.encoder(image * 2 - 1, batch, progress)
        disparity = depth_network.disparity(maps)
        # What PyTorch makes of a number over a tensor, for a tensor over a tensor too: the same bits.
        start = make_start(image, disparity.clamp(*DISPARITY_RANGE).reciprocal() * disparity_factor)
        return Seen(start, torch.cat([image, start.disparity_map], dim=1) * 2 - 1, maps)

    def gaussian_decoder(self) -> GaussianDecoder:
        """The rest, by itself: the same modules under the same names."""
        return GaussianDecoder(self.feature_model, self.prediction_head)


class DepthNetwork(nn.Module):
    """Two layers of disparity, in the way of Depth Pro."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        width = config.depth_width
        self.encoder = SlidingPyramid(config)
        self.decoder = Decoder((width, *config.pyramid), width)
        self.head = nn.Sequential(
            nn.Conv2d(width, width // 2, 3, padding=1),
            nn.ConvTranspose2d(width // 2, width // 2, 2, stride=2),
            nn.Conv2d(width // 2, HIDDEN, 3, padding=1),
            nn.ReLU(inplace=True),
            ExactConv(HIDDEN, LAYERS, 1),
            nn.ReLU(inplace=True),
        )

    def disparity(self, maps: list[Tensor]) -> Tensor:
        """[1, 2, side, side] ≥ 0, float32."""
        out: Tensor = self.head(self.decoder(maps))
        return out


GEOMETRY, TEXTURE = 3, 11  # delta channels: offset; scale 3, quaternion 4, colour 3, opacity 1


class FeatureNetwork(nn.Module):
    """Features for the deltas from the pyramid, the picture and its disparity."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        width = config.gaussian_width
        self.decoder = Decoder((config.depth_width, *config.pyramid), width)
        self.image_encoder = nn.Module()
        self.image_encoder.conv = ExactConv(3 + LAYERS, width, STRIDE, stride=STRIDE)
        self.fusion = Fusion(width, doubles=False)
        self.texture_head = _head(width, config.feature_width)
        self.geometry_head = _head(width, config.feature_width)

    def forward(self, picture: Tensor, maps: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Texture and geometry features [1, F, side/2, side/2] of [1, 5, side, side] in -1..1."""
        features = self.decoder(maps)
        features = self.fusion(features, self.image_encoder.conv(picture).to(features))  # type: ignore[operator]
        return self.texture_head(features), self.geometry_head(features)


class PredictionHead(nn.Module):
    """Features to deltas."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.geometry_prediction_head = ExactConv(width, GEOMETRY * LAYERS, 1)
        self.texture_prediction_head = ExactConv(width, TEXTURE * LAYERS, 1)

    def forward(self, texture: Tensor, geometry: Tensor) -> Tensor:
        """[14, 2, H, W] float32."""
        geometry = self.geometry_prediction_head(geometry)[0].unflatten(0, (GEOMETRY, LAYERS))
        texture = self.texture_prediction_head(texture)[0].unflatten(0, (TEXTURE, LAYERS))
        return torch.cat([geometry, texture])


class GaussianDecoder(nn.Module):
    """Both, as one module: the part of SHARP that may learn while the rest stays; 7,784,028 weights when published."""

    def __init__(self, feature_model: FeatureNetwork, prediction_head: PredictionHead) -> None:
        super().__init__()
        self.feature_model = feature_model
        self.prediction_head = prediction_head

    def let_learn(self) -> GaussianDecoder:
        """Ask for gradients, but not of what the checkpoint has and nothing uses: 295,168 weights when published."""
        self.requires_grad_()
        coarsest: Fusion = self.feature_model.decoder.fusions[-1]  # type: ignore[assignment]
        coarsest.resnet1.requires_grad_(False)  # for finer features, and here there is nothing to add them to
        return self

    def forward(self, picture: Tensor, maps: list[Tensor]) -> Tensor:
        """Deltas [14, 2, side/2, side/2] float32 of a picture [1, 5, side, side] and its maps (see `Seen`)."""
        deltas: Tensor = self.prediction_head(*self.feature_model(picture, maps))
        return deltas


def _head(width: int, out: int) -> nn.Sequential:
    blocks, last = [normed_residual(width, width) for _ in range(2)], nn.Conv2d(width, out, 1)
    return nn.Sequential(*blocks, nn.ReLU(inplace=True), last, nn.ReLU(inplace=True))


NEAREST, FARTHEST = 1.0, 100.0  # depths are scaled so that the nearest is 1, and cut off at 100
FARTHEST_INVERSE = 1e-3  # added to inverse depth, which keeps depth finite
SMALLEST_INVERSE = 1e-6
COLOR_MARGIN = 0.01  # keeps the inverse sigmoid of a colour finite
MAX_SCALE = 10.0  # of a Gaussian, relative to where it starts

# How much a delta of one moves an attribute, before the sigmoid where there is one.
XY_GAIN = Z_GAIN = 0.001
COLOR_GAIN = 0.1


@dataclasses.dataclass(frozen=True)
class InitialGaussians:
    """Gaussians on the predicted surfaces, one for each 2×2 pixels and layer, before any delta."""

    disparity_map: Tensor  # [1, 2, side, side] of the scaled depths, an input of the feature network
    disparity: Tensor  # [2, side/2, side/2] of the nearest pixel in each cell
    color: Tensor  # [3, side/2, side/2] sRGB, the cell's mean
    unscale: Tensor  # float64 without an axis: multiplies means and scales to undo the scaling of the depths


def make_start(image: Tensor, depth: Tensor) -> InitialGaussians:
    """Where the Gaussians of a picture [1, 3, side, side] with depth layers [1, 2, side, side] begin."""
    factor = NEAREST / (depth.min().double() + SMALLEST_INVERSE)  # stays on its device: nobody waits for it
    disparity = 1.0 / (depth * factor).clamp_max(FARTHEST)
    return InitialGaussians(disparity, max_pool2d(disparity, STRIDE)[0], avg_pool2d(image, STRIDE)[0], 1.0 / factor)


def compose(start: InitialGaussians, deltas: Tensor) -> Gaussians:
    """Apply deltas [14, 2, H, W]; the Gaussians come layer by layer, each in row-major order.

    Means are (x·z, y·z, z), where x and y run from -1 to 1 over the picture.
    """
    height, width = deltas.shape[-2:]
    x, y = ((2 * torch.arange(n, device=deltas.device) + 1) / n - 1 for n in (width, height))  # of the cells' centres
    inverse = softplus(_inverse_softplus(start.disparity) + Z_GAIN * deltas[2])
    z = 1.0 / (inverse + FARTHEST_INVERSE)
    means = torch.stack([z * (x + XY_GAIN * deltas[0]), z * (y[:, None] + XY_GAIN * deltas[1]), z])
    # A cell's width at that depth, times a factor between 0 and MAX_SCALE: 1 at zero, and so is its slope.
    slope, shift = MAX_SCALE / (MAX_SCALE - 1), -math.log(MAX_SCALE - 1)
    scales = (2.0 / width) * z * (MAX_SCALE * torch.sigmoid(slope * deltas[3:6] + shift))
    quats = torch.cat([deltas[6:7] + 1, deltas[7:10]])
    color = start.color.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
    colors = srgb_to_linear(torch.sigmoid(torch.logit(color)[:, None] + COLOR_GAIN * deltas[10:13]))
    opacities = torch.sigmoid(deltas[13])
    return Gaussians(
        _rows(means * start.unscale), _rows(quats), _rows(scales * start.unscale), opacities.flatten(), _rows(colors)
    )


def _inverse_softplus(y: Tensor) -> Tensor:
    """log(eʸ - 1) for y > 0 without overflow."""
    y = y.clamp_min(SMALLEST_INVERSE)
    return y + torch.log(-torch.expm1(-y))


def _rows(attribute: Tensor) -> Tensor:
    """[C, 2, H, W] to [2·H·W, C]."""
    return attribute.flatten(1).T.contiguous()
