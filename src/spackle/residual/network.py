"""The residual network f_res (paper, eq. 4): cues of a view in, a delta for every cell out."""

from __future__ import annotations

import copy
import itertools
import math

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from spackle.precision import Precision, pick_dtype
from spackle.residual.compose import COLOR, DELTA_CHANNELS, GEOMETRY_CHANNELS, TEXTURE_CHANNELS, color_logit
from spackle.residual.crops import crops_around
from spackle.residual.cues import Cues
from spackle.residual.rim import Rim
from spackle.residual.seeds import Seeds

CUE_CHANNELS = 10  # rendered colour 3, depth, opacity, mask, seed colour 3, seed depth
NEAR = slice(CUE_CHANNELS, CUE_CHANNELS + 3)  # what turns the seed's colour into that of the far rim
MIRRORED = slice(NEAR.stop, NEAR.stop + 3)  # and into the one mirrored at the rim
IN_CHANNELS = MIRRORED.stop + 1  # and the distance to the rim
COPIES = 2  # channels that say how much of each to take
RIM_CELLS = 16.0  # a typical distance to the rim
WIDTHS = (48, 80, 128, 256, 256)  # channels from the finest grid to the coarsest
COARSE_BLOCKS = 3  # residual blocks at the coarsest grid, where context is wide and cheap
STRIDE = 2 ** (len(WIDTHS) - 1)
STEM_GAIN = 3.0  # the features are of order 0.3


class ResidualBlock(nn.Module):
    """x + conv(act(conv(act(x)))), starting as the identity.

    There is no normalisation: statistics over an image would make a crop's result depend on the crop.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, h, w] to the same shape."""
        out: Tensor = x + self.second(torch.relu(self.first(torch.relu(x))))
        return out


class ResidualNet(nn.Module):
    """Encoder of the cues, decoder, and SHARP's two heads: 8.02 M parameters.

    The last layers start at zero, so an untrained network returns the seeds unchanged.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(IN_CHANNELS, WIDTHS[0], 3, padding=1)
        pairs = list(itertools.pairwise(WIDTHS))
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairs)
        self.encode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.coarse = nn.Sequential(*(ResidualBlock(WIDTHS[-1]) for _ in range(COARSE_BLOCKS)))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.decode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.geometry = _head(WIDTHS[0], GEOMETRY_CHANNELS)
        self.texture = _head(WIDTHS[0], TEXTURE_CHANNELS + COPIES)
        _initialise(self)

    def forward(self, features: Tensor) -> Tensor:
        """Features [B, 17, h, w] of `network_input` to deltas [B, 14, h, w]; any h and w."""
        height, width = features.shape[-2:]
        x = self.stem(pad(features, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate"))
        skips = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.coarse(x)
        for up, decode, skip in reversed(list(zip(self.up, self.decode, skips, strict=True))):
            x = decode(skip + interpolate(up(x), scale_factor=2, mode="bilinear", align_corners=False))
        heads = torch.cat([self.geometry(x), self.texture(x)], dim=1)[..., :height, :width]
        deltas, copies = heads[:, :-COPIES], heads[:, -COPIES:]
        # Colours that are there need not be learnt: it is enough to say how much of them to take.
        taken = copies[:, :1] * features[:, NEAR] + copies[:, 1:] * features[:, MIRRORED]
        return torch.cat([deltas[:, : COLOR.start], deltas[:, COLOR] + taken, deltas[:, COLOR.stop :]], dim=1)


def network_input(cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
    """Features [1, 17, h, w], centred around zero; depths as log inverse depth over the view's median."""
    cue_depth = torch.where(cues.inverse_depth > 0, (cues.inverse_depth / seeds.unit).clamp_min(1e-4).log(), 0.0)
    seed_depth = (seeds.inverse_depth / seeds.unit).clamp_min(1e-4).log()
    maps = [cue_depth, cues.alpha, cues.mask.to(cues.alpha), seed_depth]
    own = color_logit(seeds.rgb)
    channels = [cues.rgb - 0.5, torch.stack(maps, dim=-1), seeds.rgb - 0.5]
    channels += [color_logit(rim.rgb) - own, color_logit(rim.mirrored) - own]
    channels += [(rim.distance / RIM_CELLS).log1p()[..., None]]
    return torch.cat(channels, dim=-1).permute(2, 0, 1)[None].detach()


@torch.no_grad()
def predict_deltas(
    network: nn.Module, cues: Cues, seeds: Seeds, rim: Rim, precision: Precision = "auto", *, dense: bool = False
) -> Tensor:
    """Deltas [h, w, 14] float32 of a view's masked cells; nothing of use at the others.

    The network looks only around the masked cells, see `spackle.residual.crops`.

    Args:
        network: a `ResidualNet`.
        cues, seeds, rim: of the same view.
        precision: of the convolutions; auto is bfloat16 where the hardware multiplies it natively.
        dense: deltas of all cells.
    """
    features = network_input(cues, seeds, rim).contiguous(memory_format=torch.channels_last)
    dtype = pick_dtype(precision, features.device)
    field = features.new_zeros(*features.shape[-2:], DELTA_CHANNELS)
    for inner, outer in crops_around(torch.ones_like(cues.mask) if dense else cues.mask, STRIDE):
        rows, columns = outer.slices
        with torch.autocast(features.device.type, dtype, enabled=dtype != torch.float32):
            seen: Tensor = network(features[..., rows, columns])[0].permute(1, 2, 0)
        field[inner.slices] = seen[inner.within(outer).slices].float()
    return field


def compile_network(network: ResidualNet, backend: str = "inductor") -> ResidualNet:
    """The same network, sharing its weights, that `torch.compile` translates when it is first asked.

    It takes a C++ compiler on a processor, and minutes rather than seconds, but not again for each size; a machine that
    cannot do it says so by a RuntimeError at the first call. Values differ from the network's by rounding.

    Args:
        network: stays as it is.
        backend: one of PyTorch's; "eager" translates nothing.
    """
    twin = copy.copy(network)
    twin.compile(dynamic=True, backend=backend)
    return twin


def _head(width: int, channels: int) -> nn.Sequential:
    return nn.Sequential(ResidualBlock(width), nn.ReLU(), nn.Conv2d(width, channels, 1))


def _initialise(network: ResidualNet) -> None:
    """Numbers of order one at every scale, blocks that start as the identity, and heads that start at zero."""
    for name, module in network.named_modules():
        if not isinstance(module, nn.Conv2d):
            continue
        zero = name.endswith("second") or name in ("geometry.2", "texture.2")
        gain = 0.0 if zero else STEM_GAIN if name == "stem" else math.sqrt(2) if name.endswith("first") else 1.0
        nn.init.normal_(module.weight, std=gain / math.sqrt(module.weight[0].numel()))
        nn.init.zeros_(module.bias)  # type: ignore[arg-type]
