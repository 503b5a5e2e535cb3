"""The network of LaMa, for inference only (Suvorov et al., WACV 2022).

Its convolutions are fast Fourier convolutions: part of the channels passes through a spectrum.

`expected_shapes` names the published tensors, `LamaNetwork` computes with them.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spackle.weights.checkpoints import TensorShapes

Tensors = Mapping[str, Tensor]

# The size of the published network "big-lama": channels after the first layer, and residual
# blocks in the middle.
BIG_LAMA_WIDTH = 64
BIG_LAMA_BLOCKS = 18

# In the middle of the network, the first quarter of the channels is local: it is made by
# convolutions alone. The others are global: they pass through a Fourier transform.
LOCAL_CHANNEL_DIVISOR = 4

BATCH_NORM_EPSILON = 1e-5

INPUT_CHANNELS = 4  # red, green, blue, and 1 in a hole

# Side of the first and the last layer's kernel in pixels.
LARGE_KERNEL = 7

FIRST_WEIGHT = "model.1.ffc.convl2l.weight"


def expected_shapes(
    width: int = BIG_LAMA_WIDTH, block_count: int = BIG_LAMA_BLOCKS
) -> TensorShapes:
    """Return the shapes of the published network's tensors by their names.

    In these names, model.N is the network's layer N. The counts of training batches, which a batch
    norm also has, are left out.

    Args:
        width: channels after the first layer.
        block_count: residual blocks of two Fourier layers each.
    """
    shapes: TensorShapes = {}
    # The image is halved three times, and the channels double each time. The first of these deep
    # channels are local (made by convolutions alone), the others pass through a Fourier transform.
    deep = 8 * width
    local = deep // LOCAL_CHANNEL_DIVISOR
    global_ = deep - local

    # The names are those of the original code: l is local, g is global, l2g from local to global.
    # A convolution's shape is (outputs, inputs, rows, columns).
    first_shape = (width, INPUT_CHANNELS, LARGE_KERNEL, LARGE_KERNEL)
    _add_convolution(shapes, "model.1.ffc.convl2l", first_shape)
    _add_batch_norm(shapes, "model.1.bn_l", width)
    for stage, channels in ((2, 2 * width), (3, 4 * width)):
        _add_convolution(shapes, f"model.{stage}.ffc.convl2l", (channels, channels // 2, 3, 3))
        _add_batch_norm(shapes, f"model.{stage}.bn_l", channels)
    for letter, channels in (("l", local), ("g", global_)):
        _add_convolution(shapes, f"model.4.ffc.convl2{letter}", (channels, deep // 2, 3, 3))
        _add_batch_norm(shapes, f"model.4.bn_{letter}", channels)

    for name in _fourier_layer_names(block_count):
        _add_fourier_layer(shapes, name, local, global_)

    up_channels = (deep, deep // 2, deep // 4)
    for stage, channels in zip(_up_stages(block_count), up_channels, strict=True):
        # Of a transposed convolution, the second dimension is that of the outputs.
        _add_convolution(shapes, f"model.{stage}", (channels, channels // 2, 3, 3))
        shapes[f"model.{stage}.bias"] = (channels // 2,)
        _add_batch_norm(shapes, f"model.{stage + 1}", channels // 2)
    last = f"model.{_last_stage(block_count)}"
    _add_convolution(shapes, last, (3, width, LARGE_KERNEL, LARGE_KERNEL))
    shapes[f"{last}.bias"] = (3,)
    return shapes


def _add_fourier_layer(shapes: TensorShapes, name: str, local: int, global_: int) -> None:
    """Add the shapes of a Fourier layer to `shapes`.

    In the published names, l is local and g is global: convl2g leads from local to global
    channels, and bn_g is the batch norm of the global outputs. Local channels are made by
    convolutions alone; global ones pass through a Fourier transform.

    Args:
        shapes: shapes by the tensors' names.
        name: the layer's name.
        local, global_: how many channels are local and global.
    """
    spectral = f"{name}.ffc.convg2g"
    # conv1 halves the channels before the Fourier transform, and conv2 restores them after it.
    half = global_ // 2
    _add_convolution(shapes, f"{name}.ffc.convl2l", (local, local, 3, 3))
    _add_batch_norm(shapes, f"{name}.bn_l", local)
    _add_convolution(shapes, f"{name}.ffc.convl2g", (global_, local, 3, 3))
    _add_batch_norm(shapes, f"{name}.bn_g", global_)
    _add_convolution(shapes, f"{name}.ffc.convg2l", (local, global_, 3, 3))
    _add_convolution(shapes, f"{spectral}.conv1.0", (half, global_, 1, 1))
    _add_batch_norm(shapes, f"{spectral}.conv1.1", half)
    # The spectrum of `half` channels has as many real and as many imaginary parts.
    _add_convolution(shapes, f"{spectral}.fu.conv_layer", (global_, global_, 1, 1))
    _add_batch_norm(shapes, f"{spectral}.fu.bn", global_)
    _add_convolution(shapes, f"{spectral}.conv2", (global_, half, 1, 1))


def _add_convolution(shapes: TensorShapes, name: str, shape: tuple[int, ...]) -> None:
    """Add the shape of a convolution's weight, without a bias, to `shapes`."""
    shapes[f"{name}.weight"] = shape


def _add_batch_norm(shapes: TensorShapes, name: str, channels: int) -> None:
    """Add the shapes of a batch norm's four tensors to `shapes`."""
    for tensor_name in ("weight", "bias", "running_mean", "running_var"):
        shapes[f"{name}.{tensor_name}"] = (channels,)


def count_blocks(tensors: Tensors) -> int:
    """Return how many residual blocks a network with these tensors has."""
    return sum(name.endswith(".conv1.bn_l.weight") for name in tensors)


def _fourier_layer_names(block_count: int) -> list[str]:
    """Return the names of the Fourier layers: two in each residual block, in their order."""
    names = []
    for block in range(block_count):
        # The first five stages, 0 to 4, lie before the blocks.
        names += [f"model.{5 + block}.conv1", f"model.{5 + block}.conv2"]
    return names


def _up_stages(block_count: int) -> range:
    """Return the numbers of the three stages that double the sides.

    A batch norm and a ReLU, which have numbers too, follow each of them.
    """
    return range(6 + block_count, 15 + block_count, 3)


def _last_stage(block_count: int) -> int:
    """Return the number of the last convolution, after the three doublings and a padding."""
    return 16 + block_count


class LamaNetwork(nn.Module):
    """Predicts colours in the holes of an image.

    The sides must be multiples of 8, and at least 16 pixels. Batch norms are folded into the
    convolutions before them; memory is channels-last.
    """

    def __init__(self, tensors: Tensors) -> None:
        """Take the published tensors, in float32, by the names of `expected_shapes`.

        In these names, l is local and g is global: convl2g leads from local to global channels,
        and bn_g is the batch norm of the global outputs.
        """
        super().__init__()
        block_count = count_blocks(tensors)
        self.first = _convolution(*_fold_batch_norm(tensors, "model.1.ffc.convl2l", "model.1.bn_l"))

        # Three layers halve the sides. In the third one, one convolution makes the local channels
        # and, after them, the global ones.
        local_weight, local_bias = _fold_batch_norm(tensors, "model.4.ffc.convl2l", "model.4.bn_l")
        global_weight, global_bias = _fold_batch_norm(
            tensors, "model.4.ffc.convl2g", "model.4.bn_g"
        )
        third_weight = torch.cat([local_weight, global_weight])
        third_bias = torch.cat([local_bias, global_bias])
        down = [
            _fold_batch_norm(tensors, "model.2.ffc.convl2l", "model.2.bn_l"),
            _fold_batch_norm(tensors, "model.3.ffc.convl2l", "model.3.bn_l"),
            (third_weight, third_bias),
        ]
        self.down = nn.ModuleList(_convolution(weight, bias, stride=2) for weight, bias in down)
        self.layers = nn.ModuleList(
            FourierLayer(tensors, name) for name in _fourier_layer_names(block_count)
        )
        self.up = nn.ModuleList()
        for stage in _up_stages(block_count):
            weight, bias = _fold_batch_norm(
                tensors, f"model.{stage}", f"model.{stage + 1}", is_transposed=True
            )
            self.up.append(_transposed_convolution(weight, bias))

        # Three output channels use a CPU's registers poorly. So the last 7×7 kernel is split into
        # 7 rows, which make 3 channels each; `logits` shifts and sums them. Each row adds a seventh
        # of the bias.
        last = f"model.{_last_stage(block_count)}"
        rows_first = tensors[f"{last}.weight"].permute(2, 0, 1, 3)  # [7, 3, width, 7]
        row_weight = rows_first.flatten(0, 1)[:, :, None]  # [21, width, 1, 7]
        row_bias = tensors[f"{last}.bias"].repeat(LARGE_KERNEL) / LARGE_KERNEL
        self.last_rows = _convolution(row_weight, row_bias)
        self.eval().requires_grad_(False)

    def forward(self, rgb: Tensor, hole: Tensor) -> Tensor:
        """Return the colours of an image with its holes filled.

        Args:
            rgb: [B, 3, H, W] sRGB in 0..1; colours in holes are ignored.
            hole: [B, 1, H, W] bool.

        Returns:
            [B, 3, H, W] in 0..1.
        """
        known_rgb = torch.where(hole, 0.0, rgb)
        return self.logits(torch.cat([known_rgb, hole.to(rgb)], 1)).sigmoid_()

    def logits(self, x: Tensor) -> Tensor:
        """Return the logits [B, 3, H, W] of the colours.

        Args:
            x: [B, 4, H, W]: colours, 0 in the holes; and the mask, 1 in the holes.
        """
        # From 4 to `width` channels; three layers then halve the sides.
        x = x.contiguous(memory_format=torch.channels_last)
        x = self.first(_pad_by_reflection(x, LARGE_KERNEL // 2)).relu_()
        for down in self.down:
            x = down(_pad_by_reflection(x, 1)).relu_()
        # Two layers make a residual block.
        for first, second in zip(self.layers[::2], self.layers[1::2], strict=True):
            x = second(first(x)).add_(x)
        for up in self.up:
            x = up(x).relu_()

        # The last convolution has its 7 kernel rows as 7 groups of 3 output channels.
        height = x.shape[2]
        rows = self.last_rows(_pad_by_reflection(x, LARGE_KERNEL // 2))  # [B, 21, H + 6, W]
        del x  # frees memory before the sum
        # Row k of the kernel acts on the image shifted by k pixels.
        shifted = [rows[:, 3 * k : 3 * k + 3, k : k + height] for k in range(LARGE_KERNEL)]
        return torch.stack(shifted).sum(0)


class FourierLayer(nn.Module):
    """A fast Fourier convolution, with local and global channels in and out."""

    def __init__(self, tensors: Tensors, name: str) -> None:
        """Take the tensors of the layer `name` from those of the network.

        In the tensors' names, l is local and g is global: convl2g leads from local to global
        channels, and bn_g is the batch norm of the global outputs.
        """
        super().__init__()
        spectral = f"{name}.ffc.convg2g"
        # The local outputs are batch_norm(conv(local) + conv(global)). One convolution over all
        # channels computes the sum; the batch norm is folded into its weight and bias.
        local_scale, local_shift = _batch_norm_scale_and_shift(tensors, f"{name}.bn_l")
        from_local = tensors[f"{name}.ffc.convl2l.weight"]
        from_global = tensors[f"{name}.ffc.convg2l.weight"]
        to_local = torch.cat([from_local, from_global], 1)
        self.to_local = _convolution(to_local * local_scale.view(-1, 1, 1, 1), local_shift)
        self.local_to_global = _convolution(
            *_fold_batch_norm(tensors, f"{name}.ffc.convl2g", f"{name}.bn_g")
        )

        # The global outputs are batch_norm(conv(local) + widen(x + filter(x))). Here x is
        # relu(narrow(global)), with half the channels, and filter() acts on the spectrum of x.
        self.narrow = _linear(
            *_fold_batch_norm(tensors, f"{spectral}.conv1.0", f"{spectral}.conv1.1")
        )
        self.spectrum = _linear(
            *_fold_batch_norm(tensors, f"{spectral}.fu.conv_layer", f"{spectral}.fu.bn")
        )
        # Of the batch norm, which is scale · (…) + shift, `local_to_global` adds the shift, which
        # must be added only once.
        global_scale, _ = _batch_norm_scale_and_shift(tensors, f"{name}.bn_g")
        wide_weight = tensors[f"{spectral}.conv2.weight"]
        self.widen = _linear(wide_weight * global_scale.view(-1, 1, 1, 1), bias=None)

    def forward(self, x: Tensor) -> Tensor:
        """Map features [B, C, h, w] to the same shape.

        The first quarter of the channels is local, and is made by convolutions alone; the others
        are global, and pass through a Fourier transform.
        """
        local_count = x.shape[1] // LOCAL_CHANNEL_DIVISOR
        padded = _pad_by_reflection(x, 1)
        local = self.to_local(padded)
        padded_local = padded[:, :local_count].contiguous(memory_format=torch.channels_last)
        global_ = self.local_to_global(padded_local)
        del padded  # frees memory before the Fourier transform
        # The Fourier transform's layers take the channels last. permute() copies nothing, so the
        # sum goes into the memory of `global_`.
        global_input = x[:, local_count:].permute(0, 2, 3, 1)
        global_.permute(0, 2, 3, 1).add_(self._filter_spectrum(global_input))
        return torch.cat([local, global_], 1).relu_()

    def _filter_spectrum(self, x: Tensor) -> Tensor:
        """Map features to the same shape by a linear layer on their two-dimensional spectrum.

        Args:
            x: [B, h, w, D] global features, D channels.
        """
        x = self.narrow(x).relu_()  # [B, h, w, D / 2]
        spectrum = torch.fft.rfft2(x, dim=(1, 2), norm="ortho")
        # The linear layer takes the real part of the first channel, its imaginary part, the real
        # part of the second channel, and so on.
        parts = torch.view_as_real(spectrum.contiguous()).flatten(-2)  # [B, h, w / 2 + 1, D]
        parts = self.spectrum(parts).relu_().unflatten(-1, (-1, 2))
        filtered_spectrum = torch.view_as_complex(parts)
        filtered = torch.fft.irfft2(filtered_spectrum, s=x.shape[1:3], dim=(1, 2), norm="ortho")
        return self.widen(x.add_(filtered))  # type: ignore[no-any-return]


def _batch_norm_scale_and_shift(tensors: Tensors, norm: str) -> tuple[Tensor, Tensor]:
    """Return what a batch norm does to each channel, as scale and shift [C]: scale · x + shift."""
    mean = tensors[f"{norm}.running_mean"]
    variance = tensors[f"{norm}.running_var"]
    scale = tensors[f"{norm}.weight"] / torch.sqrt(variance + BATCH_NORM_EPSILON)
    return scale, tensors[f"{norm}.bias"] - mean * scale


def _fold_batch_norm(
    tensors: Tensors, convolution: str, norm: str, *, is_transposed: bool = False
) -> tuple[Tensor, Tensor]:
    """Return weight and bias of a convolution that also does what the batch norm after it does.

    The batch norm computes scale · x + shift, so that weight and bias are multiplied by the scale,
    and the shift is added to the bias.

    Args:
        tensors: the network's tensors.
        convolution: the convolution's name.
        norm: the batch norm's name.
        is_transposed: whether the convolution is transposed, so that its weight has the output
            channels second.
    """
    scale, shift = _batch_norm_scale_and_shift(tensors, norm)
    scale_shape = (1, -1, 1, 1) if is_transposed else (-1, 1, 1, 1)
    weight = tensors[f"{convolution}.weight"] * scale.view(scale_shape)
    bias = tensors.get(f"{convolution}.bias")
    if bias is None:
        return weight, shift
    return weight, shift + bias * scale


def _convolution(weight: Tensor, bias: Tensor, *, stride: int = 1) -> nn.Conv2d:
    """Return a convolution with this weight [out, in, h, w] and bias [out]."""
    out_channels, in_channels, height, width = weight.shape
    # On the meta device, no memory is taken before the weight is set.
    convolution = nn.Conv2d(in_channels, out_channels, (height, width), stride, device="meta")
    convolution.weight = nn.Parameter(weight.contiguous(memory_format=torch.channels_last))
    convolution.bias = nn.Parameter(bias)
    return convolution


def _transposed_convolution(weight: Tensor, bias: Tensor) -> nn.ConvTranspose2d:
    """Return a convolution that doubles the sides, with weight [in, out, h, w] and bias [out]."""
    in_channels, out_channels, height, width = weight.shape
    # With these paddings, a 3×3 kernel exactly doubles the sides. On the meta device, no memory is
    # taken before the weight is set.
    convolution = nn.ConvTranspose2d(
        in_channels,
        out_channels,
        (height, width),
        stride=2,
        padding=1,
        output_padding=1,
        device="meta",
    )
    convolution.weight = nn.Parameter(weight.contiguous(memory_format=torch.channels_last))
    convolution.bias = nn.Parameter(bias)
    return convolution


def _linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    """Return a 1×1 convolution, with weight [out, in, 1, 1], for features with channels last."""
    out_channels, in_channels = weight.shape[:2]
    # On the meta device, no memory is taken before the weight is set.
    linear = nn.Linear(in_channels, out_channels, bias=bias is not None, device="meta")
    linear.weight = nn.Parameter(weight.flatten(1).contiguous())
    if bias is not None:
        linear.bias = nn.Parameter(bias)
    return linear


def _pad_by_reflection(x: Tensor, margin: int) -> Tensor:
    """Pad all four sides of features [B, C, h, w] by `margin` pixels, mirrored at the border."""
    return F.pad(x, (margin, margin, margin, margin), mode="reflect")
