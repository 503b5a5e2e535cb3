"""LaMa: a network with fast Fourier convolutions (Suvorov et al., WACV 2022), run on crops around holes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spackle.core.crop import Crop
from spackle.core.photo import working_size
from spackle.inpaint.protocol import InpainterOptions
from spackle.runtime.device import pick_device, report_memory_shortage, without_autocast_or_tf32
from spackle.runtime.errors import InputError
from spackle.weights import installed_weights
from spackle.weights.checkpoints import TensorShapes, check_finite, check_tensors, read_tensors

SIDE = 1024  # default for the long side of the input in pixels
MULTIPLE = 8  # both sides of the network's input are multiples of this
SMALLEST = (
    2 * MULTIPLE
)  # least side in pixels: features have an eighth of the side and are padded by reflection
MARGIN = 128  # pixels around a group of holes in the network's input
BLOCK = 16  # pixels of the grid on which groups are found
LOCAL = 4  # one of so many channels is local, all others are global
EPSILON = 1e-5  # of batch norms
WIDTH, BLOCKS = 64, 18  # size of the published network "big-lama"
FIRST = "model.1.ffc.convl2l.weight"
ADVICE = "`spackle weights get lama` downloads LaMa's weights"
Tensors = Mapping[str, Tensor]


class LamaInpainter:
    """Paints each view by itself."""

    name = "lama"
    uses_network: ClassVar[bool] = True
    paints_views_together: ClassVar[bool] = False
    notice: ClassVar[str] = ""

    def __init__(self, options: InpainterOptions) -> None:
        """Load the network; InputError for an invalid side or device, or unsuitable weights."""
        self._side = options.side_or(SIDE)
        self._device = pick_device(options.device)
        path = options.weights or installed_weights("lama")
        if path is None:
            raise InputError(
                "inpainter lama: no weights: `spackle weights get lama` downloads 206 MB"
            )
        self.weight_files: Mapping[str, Path] = {"lama": path}
        self._network = load_network(path).to(self._device)
        self.version = f"1, long side {self._side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the views, see `Inpainter.paint`; InputError if memory is short, or the colours are not finite."""
        painted = rgb.clone()
        for view, mask, target in zip(rgb, hole, painted, strict=True):
            for group, crop in groups_of(mask):
                drawn = torch.empty_like(view)
                drawn[crop.slices] = self._draw(view[crop.slices], mask[crop.slices]).to(drawn)
                masked = mask[group.slices]
                target[group.slices][masked] = drawn[group.slices][masked]
        return painted

    def _draw(self, rgb: Tensor, hole: Tensor) -> Tensor:
        """The network's output [h, w, 3] for an image [h, w, 3] with holes [h, w]."""
        height, width = hole.shape
        colors = torch.where(hole[..., None], 0.0, rgb).permute(2, 0, 1)[None].to(self._device)
        mask = hole[None, None].to(self._device)
        small = working_size(width, height, self._side)[::-1]
        if small != (height, width):
            known = F.adaptive_avg_pool2d((~mask).to(colors), small)
            mask = known < 0.999  # a reduced pixel is masked if any part lies in a hole
            colors = F.adaptive_avg_pool2d(colors, small)
        shortage = report_memory_shortage(
            "lower --inpainter-side", what=f"for LaMa at {max(small)} pixels"
        )
        with shortage, without_autocast_or_tf32(self._device):
            drawn: Tensor = self._network(padded(colors), padded(mask))[..., : small[0], : small[1]]
        if not bool(drawn.isfinite().all()):
            raise InputError(
                f"{self.weight_files['lama']}: LaMa's colours are not finite: give other weights"
            )
        if small != (height, width):
            drawn = F.interpolate(drawn, (height, width), mode="bicubic").clamp_(0, 1)
        return drawn[0].permute(1, 2, 0)


def groups_of(hole: Tensor) -> list[tuple[Crop, Crop]]:
    """Rectangles around groups of holes [H, W], each with the larger crop that the network receives.

    Two rectangles are merged if they touch, or if one common crop has no more pixels than the two crops.
    """

    def seen(group: Crop) -> Crop:
        return group.grown(MARGIN, MULTIPLE, *hole.shape)

    def belong(one: Crop, other: Crop) -> bool:
        return (
            one.touches(other) or seen(one.union(other)).area <= seen(one).area + seen(other).area
        )

    blocks = F.max_pool2d(hole[None].float(), BLOCK, ceil_mode=True)[0].cpu().numpy() > 0
    groups: list[Crop] = []
    for row, column in zip(*blocks.nonzero(), strict=True):
        group = Crop(*(BLOCK * int(index) for index in (row, column, row + 1, column + 1)))
        while near := [other for other in groups if belong(group, other)]:
            groups.remove(near[0])
            group = group.union(near[0])
        groups.append(group)
    return [(group, seen(group)) for group in groups]


def padded(x: Tensor) -> Tensor:
    """Pad [B, C, H, W] to sides that the network accepts, by reflection to the right and below."""
    for axis in (-2, -1):
        side = x.shape[axis]
        steps = torch.arange(max(SMALLEST, -(-side // MULTIPLE) * MULTIPLE), device=x.device) % max(
            2 * side - 2, 1
        )
        x = x.index_select(axis, torch.minimum(steps, 2 * side - 2 - steps))
    return x


def load_network(path: Path) -> LamaNetwork:
    """Load the network, of any width and depth, from TorchScript (without running code), `torch.save` or safetensors.

    Names of tensors may begin with the path to the generator; tensors of other networks are ignored. InputError if the
    file is missing or broken, or holds another network.
    """
    found = read_tensors(path, ADVICE)
    before = (name.removesuffix(FIRST) for name in found if name.endswith(FIRST))
    prefix = min(
        (start for start in before if not start or start.endswith("generator.")),
        key=len,
        default=None,
    )
    if prefix is None:
        raise InputError(f"{path}: holds no generator of LaMa: {ADVICE}")
    tensors = {
        name.removeprefix(prefix): tensor
        for name, tensor in found.items()
        if name.startswith(f"{prefix}model.") and not name.endswith(".num_batches_tracked")
    }
    blocks = sum(name.endswith(".conv1.bn_l.weight") for name in tensors)
    check_tensors(tensors, expected_shapes(sum(tensors[FIRST].shape[:1]), blocks), path, ADVICE)
    network = LamaNetwork(
        {name: tensor.to(torch.float32, copy=True) for name, tensor in tensors.items()}
    )
    check_finite(network, path, ADVICE)
    return network


# The network --------------------------------------------------------------------------------------


def expected_shapes(width: int = WIDTH, blocks: int = BLOCKS) -> TensorShapes:
    """Names and shapes of the published tensors, without `num_batches_tracked`."""
    shapes: TensorShapes = {}

    def add(
        conv: str, norm: str | None, *shape: int, bias: bool = False, transposed: bool = False
    ) -> None:
        """Add a convolution, and the batch norm `norm` of its outputs."""
        shapes[f"{conv}.weight"], outputs = shape, (shape[transposed],)
        if bias:
            shapes[f"{conv}.bias"] = outputs
        if norm:
            shapes.update(
                {
                    f"{norm}.{key}": outputs
                    for key in ("weight", "bias", "running_mean", "running_var")
                }
            )

    deep = 8 * width
    near, far, half = deep // LOCAL, deep - deep // LOCAL, (deep - deep // LOCAL) // 2
    add("model.1.ffc.convl2l", "model.1.bn_l", width, 4, 7, 7)
    for stage, channels in ((2, 2 * width), (3, 4 * width)):
        add(f"model.{stage}.ffc.convl2l", f"model.{stage}.bn_l", channels, channels // 2, 3, 3)
    for name, channels in (("l", near), ("g", far)):
        add(f"model.4.ffc.convl2{name}", f"model.4.bn_{name}", channels, deep // 2, 3, 3)
    for name in _layer_names(blocks):
        spectral = f"{name}.ffc.convg2g"
        add(f"{name}.ffc.convl2l", f"{name}.bn_l", near, near, 3, 3)
        add(f"{name}.ffc.convl2g", f"{name}.bn_g", far, near, 3, 3)
        add(f"{name}.ffc.convg2l", None, near, far, 3, 3)
        add(f"{spectral}.conv1.0", f"{spectral}.conv1.1", half, far, 1, 1)
        add(f"{spectral}.fu.conv_layer", f"{spectral}.fu.bn", far, far, 1, 1)
        add(f"{spectral}.conv2", None, far, half, 1, 1)
    for stage, channels in zip(_up_stages(blocks), (deep, deep // 2, deep // 4), strict=True):
        add(
            f"model.{stage}",
            f"model.{stage + 1}",
            channels,
            channels // 2,
            3,
            3,
            bias=True,
            transposed=True,
        )
    add(f"model.{_last_stage(blocks)}", None, 3, width, 7, 7, bias=True)
    return shapes


def _layer_names(blocks: int) -> list[str]:
    return [f"model.{5 + block}.conv{half}" for block in range(blocks) for half in (1, 2)]


def _up_stages(blocks: int) -> range:
    return range(6 + blocks, 15 + blocks, 3)


def _last_stage(blocks: int) -> int:
    return 16 + blocks


class LamaNetwork(nn.Module):
    """Predicts colours in the holes of an image; for inference only. Sides must be multiples of 8, and at least 16.

    Batch norms are folded into the convolutions before them; memory is channels-last.
    """

    def __init__(self, tensors: Tensors) -> None:
        """Take tensors with the names of `expected_shapes`, in float32."""
        super().__init__()
        blocks = sum(name.endswith("conv1.bn_l.weight") for name in tensors)
        self.first = _conv(*_folded(tensors, "model.1.ffc.convl2l", "model.1.bn_l"))
        deepest = [
            _folded(tensors, f"model.4.ffc.convl2{side}", f"model.4.bn_{side}") for side in "lg"
        ]
        stages = [
            _folded(tensors, f"model.{stage}.ffc.convl2l", f"model.{stage}.bn_l")
            for stage in (2, 3)
        ]
        stages.append(
            (torch.cat([weight for weight, _ in deepest]), torch.cat([bias for _, bias in deepest]))
        )
        self.down = nn.ModuleList(_conv(*stage, stride=2) for stage in stages)
        self.layers = nn.ModuleList(FourierLayer(tensors, name) for name in _layer_names(blocks))
        self.up = nn.ModuleList(
            _conv(
                *_folded(tensors, f"model.{stage}", f"model.{stage + 1}", transposed=True),
                transposed=True,
            )
            for stage in _up_stages(blocks)
        )
        last = f"model.{_last_stage(blocks)}"
        # Three output channels use a CPU's registers poorly: the kernel's 7 rows become channels and are summed.
        weight = tensors[f"{last}.weight"].permute(2, 0, 1, 3).flatten(0, 1)[:, :, None]
        self.rows = _conv(weight, tensors[f"{last}.bias"].repeat(7) / 7)
        self.eval().requires_grad_(False)

    def forward(self, rgb: Tensor, hole: Tensor) -> Tensor:
        """Colours [B, 3, H, W] in 0..1 for sRGB [B, 3, H, W] in 0..1 with holes [B, 1, H, W] bool."""
        return self.logits(torch.cat([torch.where(hole, 0.0, rgb), hole.to(rgb)], 1)).sigmoid_()

    def logits(self, x: Tensor) -> Tensor:
        """Logits [B, 3, H, W] of [B, 4, H, W]: colours, 0 in the holes, and the mask, 1 in the holes."""
        x = self.first(_reflected(x.contiguous(memory_format=torch.channels_last), 3)).relu_()
        for conv in self.down:
            x = conv(_reflected(x, 1)).relu_()
        for one, two in zip(self.layers[::2], self.layers[1::2], strict=True):
            x = two(one(x)).add_(x)
        for conv in self.up:
            x = conv(x).relu_()
        height = x.shape[2]
        rows = self.rows(_reflected(x, 3))
        del x
        return torch.stack(
            [rows[:, 3 * row : 3 * row + 3, row : row + height] for row in range(7)]
        ).sum(0)


class FourierLayer(nn.Module):
    """A fast Fourier convolution with local and global features."""

    def __init__(self, tensors: Tensors, name: str) -> None:
        super().__init__()
        spectral = f"{name}.ffc.convg2g"
        scale, shift = _affine(tensors, f"{name}.bn_l")
        near = torch.cat(
            [tensors[f"{name}.ffc.convl2l.weight"], tensors[f"{name}.ffc.convg2l.weight"]], 1
        )
        self.near = _conv(near * scale.view(-1, 1, 1, 1), shift)
        self.far = _conv(*_folded(tensors, f"{name}.ffc.convl2g", f"{name}.bn_g"))
        self.narrow = _linear(*_folded(tensors, f"{spectral}.conv1.0", f"{spectral}.conv1.1"))
        self.spectrum = _linear(*_folded(tensors, f"{spectral}.fu.conv_layer", f"{spectral}.fu.bn"))
        scale, _ = _affine(tensors, f"{name}.bn_g")
        self.wide = _linear(tensors[f"{spectral}.conv2.weight"] * scale.view(-1, 1, 1, 1), None)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, h, w] to the same shape; the first C / LOCAL channels are local."""
        padded, local = _reflected(x, 1), x.shape[1] // LOCAL
        near = self.near(padded)
        far = self.far(padded[:, :local].contiguous(memory_format=torch.channels_last))
        del padded
        far.permute(0, 2, 3, 1).add_(self._spectral(x[:, local:].permute(0, 2, 3, 1)))
        return torch.cat([near, far], 1).relu_()

    def _spectral(self, x: Tensor) -> Tensor:
        """Map [B, h, w, D] to the same shape: linear, linear with ReLU on the spectrum, linear.

        Real and imaginary parts of the spectrum alternate in memory, in the channel order of the published tensors.
        """
        x = self.narrow(x).relu_()
        parts = torch.view_as_real(torch.fft.rfft2(x, dim=(1, 2), norm="ortho").contiguous())
        parts = self.spectrum(parts.flatten(-2)).relu_().unflatten(-1, (-1, 2))
        filtered = torch.fft.irfft2(
            torch.view_as_complex(parts), s=x.shape[1:3], dim=(1, 2), norm="ortho"
        )
        return self.wide(x.add_(filtered))  # type: ignore[no-any-return]


def _affine(tensors: Tensors, norm: str) -> tuple[Tensor, Tensor]:
    """The scale and the offset of each channel in a batch norm."""
    mean, var, weight, bias = (
        tensors[f"{norm}.{key}"] for key in ("running_mean", "running_var", "weight", "bias")
    )
    scale = weight / torch.sqrt(var + EPSILON)
    return scale, bias - mean * scale


def _folded(
    tensors: Tensors, conv: str, norm: str, *, transposed: bool = False
) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution, with the batch norm folded in."""
    scale, shift = _affine(tensors, norm)
    shape = (1, -1, 1, 1) if transposed else (-1, 1, 1, 1)
    bias = tensors.get(f"{conv}.bias")
    return tensors[f"{conv}.weight"] * scale.view(
        shape
    ), shift if bias is None else shift + bias * scale


def _conv(weight: Tensor, bias: Tensor, *, stride: int = 1, transposed: bool = False) -> nn.Module:
    """A convolution with this weight and bias; a transposed convolution doubles the sides."""
    one, other, height, width = weight.shape
    conv: nn.Conv2d | nn.ConvTranspose2d
    if transposed:
        conv = nn.ConvTranspose2d(one, other, (height, width), 2, 1, 1, device="meta")
    else:
        conv = nn.Conv2d(other, one, (height, width), stride, device="meta")
    conv.weight = nn.Parameter(weight.contiguous(memory_format=torch.channels_last))
    conv.bias = nn.Parameter(bias)
    return conv


def _linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    """A 1×1 convolution for features with channels last."""
    linear = nn.Linear(weight.shape[1], weight.shape[0], bias is not None, device="meta")
    linear.weight = nn.Parameter(weight.flatten(1).contiguous())
    if bias is not None:
        linear.bias = nn.Parameter(bias)
    return linear


def _reflected(x: Tensor, margin: int) -> Tensor:
    return F.pad(x, (margin,) * 4, mode="reflect")
