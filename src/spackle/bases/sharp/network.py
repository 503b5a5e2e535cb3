"""SHARP (Apple, 2025): one picture to the deltas of two layers of Gaussians. Modules are named as in its checkpoint."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from spackle.bases.protocol import Progress
from spackle.bases.sharp.config import LAYERS, STRIDE, SharpConfig
from spackle.bases.sharp.decoder import Decoder, Fusion, normed_residual
from spackle.bases.sharp.precision import ExactConv
from spackle.bases.sharp.pyramid import SlidingPyramid
from spackle.bases.sharp.start import Start, make_start

DISPARITY_RANGE = (1e-4, 1e4)  # what the depth head says is clamped to it
HIDDEN = 32  # channels before the last layer of the depth head
GEOMETRY, TEXTURE = 3, 11  # delta channels: offset; scale 3, quaternion 4, colour 3, opacity 1


@dataclasses.dataclass(frozen=True)
class SharpOutput:
    """What the network says about one picture."""

    start: Start  # Gaussians on the two surfaces
    deltas: Tensor  # [14, 2, side/2, side/2] float32, to be applied to them


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
        self, image: Tensor, disparity_factor: float, batch: int, progress: Progress | None = None
    ) -> SharpOutput:
        """Predict from a picture [1, 3, side, side] of sRGB in 0..1, float32.

        Args:
            image: the photo, stretched to the square.
            disparity_factor: focal length over width, both in the photo's pixels.
            batch: windows that go through the transformer at once; more are no faster on a processor.
            progress: called as the transformer advances, with windows done and all of them.
        """
        depth_network: DepthNetwork = self.monodepth_model.monodepth_predictor  # type: ignore[assignment]
        maps = depth_network.encoder(image * 2 - 1, batch, progress)
        disparity = depth_network.disparity(maps)
        depth = disparity_factor / disparity.clamp(*DISPARITY_RANGE)
        start = make_start(image, depth)
        texture, geometry = self.feature_model(torch.cat([image, start.disparity_map], dim=1) * 2 - 1, maps)
        return SharpOutput(start, self.prediction_head(texture, geometry))


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


def _head(width: int, out: int) -> nn.Sequential:
    last = nn.Conv2d(width, out, 1)
    return nn.Sequential(
        normed_residual(width), normed_residual(width), nn.ReLU(inplace=True), last, nn.ReLU(inplace=True)
    )
