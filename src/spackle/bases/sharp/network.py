"""SHARP (Apple, 2025): one picture to the deltas of two layers of Gaussians. Modules are named as in its checkpoint."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from spackle.bases.protocol import Progress
from spackle.bases.sharp.config import LAYERS, SharpConfig
from spackle.bases.sharp.decoder import Decoder
from spackle.bases.sharp.heads import FeatureNetwork, GaussianDecoder, PredictionHead
from spackle.bases.sharp.precision import ExactConv
from spackle.bases.sharp.pyramid import SlidingPyramid
from spackle.bases.sharp.start import Start, make_start

DISPARITY_RANGE = (1e-4, 1e4)  # what the depth head says is clamped to it
HIDDEN = 32  # channels before the last layer of the depth head


@dataclasses.dataclass(frozen=True)
class SharpOutput:
    """What the network says about one picture."""

    start: Start  # Gaussians on the two surfaces
    deltas: Tensor  # [14, 2, side/2, side/2] float32, to be applied to them


@dataclasses.dataclass(frozen=True)
class Seen:
    """What encoder and depth network make of one picture: all that the Gaussian decoder goes by."""

    start: Start
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
        """Predict from a picture [1, 3, side, side] of sRGB in 0..1, float32.

        Args:
            image: the photo, stretched to the square.
            disparity_factor: focal length over width, both in the photo's pixels; a tensor without an axis counts, too.
            batch: windows that go through the transformer at once; more are no faster on a processor.
            progress: called as the transformer advances, with windows done and all of them.
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
