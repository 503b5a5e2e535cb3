"""SHARP's Gaussian decoder with its two heads: from what the encoder saw to deltas. Named as in the checkpoint."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spackle.bases.sharp.config import LAYERS, STRIDE, SharpConfig
from spackle.bases.sharp.decoder import Decoder, Fusion, normed_residual
from spackle.bases.sharp.precision import ExactConv

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
    last = nn.Conv2d(width, out, 1)
    return nn.Sequential(
        normed_residual(width), normed_residual(width), nn.ReLU(inplace=True), last, nn.ReLU(inplace=True)
    )
