"""The residual network f_res (paper, section 3.3, eq. 5): features of a view's holes in, a delta for every cell out.

It sees what the view shows, the base values, and what stands at a hole's far rim: along the epipolar line on which the
hole opened, and in patches of the view that match.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from spackle.camera import Camera
from spackle.crop import crops_around
from spackle.device import Precision, own_arithmetic, pick_dtype
from spackle.filters import broadly_blurred
from spackle.network_file import channels_last, load_strict, read_tensors
from spackle.patches import TONE_CELLS, Patches, match_patches
from spackle.residual.base_values import Seeds, inside_photo
from spackle.residual.epipolar_walk import walk
from spackle.residual.view_features import ViewFeatures

ALIKE = 1.4  # factor by which the inverse depths of a line's far rim and of the seed there may differ

# Channels of the features.
VIEW_CHANNELS = 10  # rendered colour 3, depth, opacity, mask, seed colour 3, seed depth
FAR_RIM = slice(VIEW_CHANNELS, VIEW_CHANNELS + 3)  # what turns the seed's colour into that of the far rim
MIRRORED = slice(FAR_RIM.stop, FAR_RIM.stop + 3)  # and into the one mirrored at the rim
EXEMPLAR = slice(MIRRORED.stop + 1, MIRRORED.stop + 4)  # after the distance to the rim: and into the patches'
IN_CHANNELS = EXEMPLAR.stop + 1  # and the patch distance
COPIES = 3  # channels that say how much of each to copy
# Channels of the deltas, as in SHARP: geometry (pixel, inverse depth), texture (scales, quaternion, colour, opacity).
DELTAS = [2, 1, 3, 4, 3, 1]
GEOMETRY_CHANNELS, TEXTURE_CHANNELS, DELTA_CHANNELS = sum(DELTAS[:2]), sum(DELTAS[2:]), sum(DELTAS)
COLOR = slice(10, 13)
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite, below 8-bit resolution

TYPICAL_DISTANCE = 16.0  # of a cell to the rim
TYPICAL_MISMATCH = 0.1
WIDTHS = (48, 80, 128, 256, 256)  # channels from the finest grid to the coarsest
COARSE_BLOCKS = 3  # residual blocks at the coarsest grid, where context is wide and cheap
STRIDE = 2 ** (len(WIDTHS) - 1)
STEM_GAIN = 3.0  # the features are of order 0.3
SHIPPED = Path(__file__).parent.parent / "weights" / "residual.safetensors"


@dataclasses.dataclass(frozen=True)
class Rim:
    """For each masked cell, what its line meets; elsewhere the cell itself."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim
    mirrored: Tensor  # [h, w, 3] sRGB as far beyond the rim as the cell is before it, if that is the same surface
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere
    exemplar: Tensor  # [h, w, 3] sRGB of patches elsewhere in the view that match; their tone is the seeds'
    mismatch: Tensor  # [h, w] patch distance: root of their mean squared difference; 0 elsewhere
    beyond: Tensor  # [h, w] bool: masked cells whose points lie outside of the photo's frame


def find_rim(features: ViewFeatures, seeds: Seeds, camera: Camera, photo_camera: Camera) -> tuple[Rim, Patches]:
    """Walk from each masked cell to both sides along its epipolar line, and take the farther surface.

    What moves in front of what, moves along the lines through the epipole, where the view sees the photo's eye. So
    that line leads from a hole to the surface that continues behind it, and structure at the rim continues along it
    more often than not. Where a line meets nothing, or something much nearer than the seed, the seeds stay.

    Also returns patches of the view that match its masked cells: by the seeds' colours behind an object, by what is
    mirrored beyond the photo's border, where the seeds mix all that reaches the border into a fog.
    """
    rgb, depths = seeds.rgb.detach(), seeds.inverse_depth.detach()
    values = torch.cat([rgb, depths[..., None]], dim=-1)
    far, near, steps = walk(seeds.uv.detach(), values, depths, features.mask, camera, photo_camera.position)
    in_front = (features.mask & (far[..., 3] > ALIKE * depths))[..., None]  # what stands there does not continue behind
    far, near = (torch.where(in_front, rgb, met[..., :3]) for met in (far, near))
    beyond = features.mask & ~inside_photo(seeds.inverse_depth, camera, photo_camera)
    tone = torch.where(features.mask[..., None], rgb, features.rgb)
    patches = match_patches(torch.where(beyond[..., None], near, tone), features.mask, depths)
    toned = (patches.rgb - broadly_blurred(patches.rgb - tone, TONE_CELLS)).clamp(0, 1)
    toned_patches = torch.where(beyond[..., None], toned, patches.rgb)
    return Rim(far, near, steps, toned_patches, patches.mismatch, beyond), patches


def network_input(view: ViewFeatures, seeds: Seeds, rim: Rim) -> Tensor:
    """Features [1, 21, h, w], centred around zero; depths as log inverse depth over the view's median."""
    view_depth = torch.where(view.inverse_depth > 0, (view.inverse_depth / seeds.unit).clamp_min(1e-4).log(), 0.0)
    seed_depth = (seeds.inverse_depth / seeds.unit).clamp_min(1e-4).log()
    maps = [view_depth, view.alpha, view.mask.to(view.alpha), seed_depth]
    grids = (seeds.rgb, rim.rgb, rim.mirrored, rim.exemplar, rim.distance[..., None], rim.mismatch[..., None])
    *colors, distance, mismatch = (grid[view.mask] for grid in grids)  # elsewhere the rim is the cell itself
    seed, near, mirrored, patches = map(color_logit, colors)
    distance, mismatch = (distance / TYPICAL_DISTANCE).log1p(), mismatch / TYPICAL_MISMATCH
    at_rim = torch.cat([near - seed, mirrored - seed, distance, patches - seed, mismatch], dim=-1)
    far = at_rim.new_zeros(*view.mask.shape, IN_CHANNELS - VIEW_CHANNELS)
    far[view.mask] = at_rim
    channels = [view.rgb - 0.5, torch.stack(maps, dim=-1), seeds.rgb - 0.5, far]
    return torch.cat(channels, dim=-1).permute(2, 0, 1)[None].detach()


def color_logit(value: Tensor) -> Tensor:
    """sigmoid⁻¹ of colours or opacities, kept off 0 and 1."""
    return torch.logit(value.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN / 2))


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
        # In place where no gradient needs what was there: at this size fresh memory costs as much as the arithmetic.
        out: Tensor = self.second(self.first(torch.relu(x)).relu_())
        return out.add_(x)


class ResidualNet(nn.Module):
    """Encoder of a view's features, decoder, and SHARP's two heads: 8.02 M parameters.

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
        """Features [B, 21, h, w] of `network_input` to deltas [B, 14, h, w]; any h and w."""
        height, width = features.shape[-2:]
        # Completed so that each level's sides are twice the next one's.
        x = self.stem(pad(features, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate"))
        skips = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.coarse(x)
        for skip, up, decode in reversed(list(zip(skips, self.up, self.decode, strict=True))):
            fine = interpolate(up(x), scale_factor=2, mode="bilinear", align_corners=False)
            x = decode(fine.add_(skip))
        heads = torch.cat([self.geometry(x), self.texture(x)], dim=1)[..., :height, :width]
        # The last outputs say how much of the known colours to take.
        deltas, shares = heads[:, :-COPIES], heads[:, -COPIES:]
        known = (FAR_RIM, MIRRORED, EXEMPLAR)
        copied = sum(shares[:, k : k + 1] * features[:, colors] for k, colors in enumerate(known))
        return torch.cat([deltas[:, : COLOR.start], deltas[:, COLOR] + copied, deltas[:, COLOR.stop :]], dim=1)


@torch.no_grad()
def predict_deltas(
    network: nn.Module,
    view: ViewFeatures,
    seeds: Seeds,
    rim: Rim,
    precision: Precision = "auto",
    *,
    dense: bool = False,
) -> Tensor:
    """Deltas [h, w, 14] float32 of a view's masked cells, on the processor; 0 elsewhere.

    The network looks only around the masked cells, see `crops_around`.

    Args:
        network: a `ResidualNet`; its features travel to the device where it lies.
        view, seeds, rim: features of one view.
        precision: of the convolutions; auto is bfloat16 where the hardware multiplies it natively.
        dense: deltas of all cells.
    """
    device = next(network.parameters()).device
    dtype = pick_dtype(precision, device)
    chosen = torch.ones_like(view.mask) if dense else view.mask
    field = view.alpha.new_zeros(*view.mask.shape, DELTA_CHANNELS)
    features = network_input(view, seeds, rim)
    # Around all crops: autocast converts the weights once.
    with own_arithmetic(device), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        for inner, outer in crops_around(chosen, STRIDE):
            part = features[(..., *outer.slices)].contiguous(memory_format=torch.channels_last).to(device)
            deltas = network(part)[0].permute(1, 2, 0)[inner.moved(-outer.top, -outer.left).slices]
            field[inner.slices] = torch.where(chosen[inner.slices][..., None], deltas.float().cpu(), 0)
    return field


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


@functools.cache
def shipped_network() -> ResidualNet | None:
    """The network with the weights that come with the package; None if a build has none."""
    return load_residual(SHIPPED) if SHIPPED.is_file() else None


def load_residual(path: str | os.PathLike[str]) -> ResidualNet:
    """Read a network; half precision is widened to single.

    Raises:
        InputError: a missing or broken file, or weights of another architecture.
    """
    advice = "give the residual's weights, 'seeds' or 'none'"
    return load_strict(ResidualNet(), read_tensors(path, advice), path, advice, prepare=channels_last)
