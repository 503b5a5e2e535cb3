"""Encode and decode the parts of a sample: pictures as PNG, Gaussians as safetensors.

The same tensors always give the same bytes. The loss in colours, opacity and depth is invisible;
the loss in Gaussians is less than 1e-3 of a pixel; masks are exact.
"""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors.numpy import load, save
from torch import Tensor
from torch.nn.functional import normalize

from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.core.image_files import check_pixel_count, open_image

PNG_COMPRESSION_LEVEL = 1  # level 6 takes three times as long and saves a tenth of the bytes
MAX_CODE = 65535  # the greatest number of 16 bits
MIN_SCALE = 1e-30  # a Gaussian's scale may be 0, which has no logarithm
MIN_RANGE = 1e-12  # least divisor, where all numbers are equal


def encode_rgb(rgb: Tensor) -> bytes:
    """A PNG of a picture [H, W, 3] sRGB in 0..1."""
    return encode_png(to_uint8(rgb).numpy())


def decode_rgb(data: bytes) -> Tensor:
    """The picture [H, W, 3] sRGB in 0..1 of a PNG."""
    return torch.from_numpy(decode_png(data, axis_count=3)).float() / 255


def encode_mask(mask: Tensor) -> bytes:
    """A PNG of a mask [H, W] bool: white where it is true, black elsewhere."""
    return encode_png(mask.cpu().numpy().astype(np.uint8) * np.uint8(255))


def decode_mask(data: bytes) -> Tensor:
    """The mask [H, W] bool of a PNG."""
    return torch.from_numpy(decode_png(data, axis_count=2)) > 127  # nearer to white than to black


def encode_alpha(alpha: Tensor, mask: Tensor, threshold: float) -> bytes:
    """A 16-bit PNG of opacity [H, W] in 0..1.

    Pixels whose opacity is below `threshold` count as uncovered; `mask` [H, W] bool marks them.
    Rounding must not change that.
    """
    codes = (alpha.detach().cpu().double() * MAX_CODE).round().clamp(0, MAX_CODE)
    # Codes that rounding has moved to the other side of the threshold are moved back.
    max_masked_code = math.ceil(threshold * MAX_CODE) - 1  # the greatest code below the threshold
    masked_codes = codes.clamp_max(max_masked_code)
    other_codes = codes.clamp_min(max_masked_code + 1)
    codes = torch.where(mask.cpu(), masked_codes, other_codes)
    return encode_png(codes.numpy().astype(np.uint16))


def decode_alpha(data: bytes) -> Tensor:
    """The opacity [H, W] in 0..1 of a 16-bit PNG."""
    codes = decode_png(data, axis_count=2).astype(np.float64)
    return torch.from_numpy(codes / MAX_CODE).float()


def encode_depth(depth: Tensor, alpha: Tensor) -> tuple[bytes, tuple[float, float]]:
    """A 16-bit PNG of depth, in logarithmic steps: the relative error is the same near and far.

    The code 0 means unknown; the codes 1 to 65535 are

        1 + 65534 · log(z / near) / log(far / near).

    Args:
        depth: expected z [H, W].
        alpha: opacity [H, W]; depth is unknown where it is 0.

    Returns:
        The PNG, and (near, far), which `decode_depth` needs; (1, 1) if no depth is known.
    """
    z = depth.detach().cpu().double().numpy()
    is_known = (alpha.detach().cpu().numpy() > 0) & np.isfinite(z) & (z > 0)
    near = far = 1.0
    if is_known.any():
        near = float(z[is_known].min())
        far = float(z[is_known].max())

    # The quotient below grows from 0 at `near` to 1 at `far`. Its divisor must not be 0 if both are
    # equal.
    log_range = max(math.log(far / near), MIN_RANGE)
    codes = np.zeros(z.shape, np.uint16)
    codes[is_known] = 1 + np.round((MAX_CODE - 1) * np.log(z[is_known] / near) / log_range)
    return encode_png(codes), (near, far)


def decode_depth(data: bytes, near: float, far: float) -> Tensor:
    """The depth z [H, W] of a PNG of `encode_depth`, with its `near` and `far`; 0 means unknown."""
    codes = decode_png(data, axis_count=2).astype(np.float64)
    z = near * np.exp((codes - 1) / (MAX_CODE - 1) * math.log(far / near))
    return torch.from_numpy(np.where(codes > 0, z, 0.0)).float()


def encode_gaussians(gaussians: Gaussians) -> bytes:
    """Gaussians as safetensors, 34 bytes each.

    Centres stay float32; quaternions and colours become half precision, opacities and the
    logarithms of scales 16-bit codes.
    """
    means, quats, scales, opacities, colors = (
        tensor.detach().cpu().float() for tensor in gaussians.tensors
    )
    # Scales span many orders of magnitude; in equal steps of the logarithm all lose the same share.
    log_scales = scales.double().clamp_min(MIN_SCALE).log()
    low = high = 0.0
    if len(means):
        low = float(log_scales.min())
        high = float(log_scales.max())
    scale_codes = ((log_scales - low) / max(high - low, MIN_RANGE) * MAX_CODE).round()
    opacity_codes = (opacities.double() * MAX_CODE).round().clamp(0, MAX_CODE)

    arrays: dict[str, NDArray[Any]] = {
        "means": means.numpy(),
        "quats": normalize(quats, dim=-1).half().numpy(),
        "scales": scale_codes.numpy().astype(np.uint16),
        "scale_logs": np.array([low, high]),
        "opacities": opacity_codes.numpy().astype(np.uint16),
        "colors": colors.half().numpy(),
    }
    return save(arrays)


def decode_gaussians(data: bytes) -> Gaussians:
    """The Gaussians, in float32, of bytes that `encode_gaussians` has made.

    Other bytes may raise any exception.
    """
    arrays = load(data)
    low, high = arrays["scale_logs"].tolist()
    # The scale that each of the 65,536 codes of 16 bits means. Looking codes up takes far less time
    # than millions of exponentials, and training decodes a photo's Gaussians for each view.
    fractions = np.arange(MAX_CODE + 1) / MAX_CODE
    scale_of_code = np.exp(low + fractions * max(high - low, MIN_RANGE)).astype(np.float32)
    columns = (
        arrays["means"],
        arrays["quats"],
        scale_of_code[arrays["scales"]],
        fractions.astype(np.float32)[arrays["opacities"]],
        arrays["colors"],
    )
    # The fields of Gaussians in their order: centres, quaternions, scales, opacities, colours.
    gaussians = Gaussians(
        *(torch.from_numpy(np.ascontiguousarray(column)).float() for column in columns)
    )
    # Half precision overflows to infinity, and damaged files hold anything.
    if not gaussians.finite:
        raise ValueError("Gaussians that are not finite")
    return gaussians


def encode_png(pixels: NDArray[Any]) -> bytes:
    """A PNG of pixels [H, W, 3] or [H, W], with 8 or 16 bits as their dtype says."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG", compress_level=PNG_COMPRESSION_LEVEL)
    return file.getvalue()


def decode_png(data: bytes, axis_count: int) -> NDArray[Any]:
    """The pixels of a PNG: [H, W, 3] if `axis_count` is 3, [H, W] if it is 2.

    ValueError or an exception of Pillow if the picture has another number of axes, is damaged, or
    claims more pixels than so few bytes can hold.
    """
    with open_image(io.BytesIO(data), ("PNG",)) as image:
        check_pixel_count(*image.size, len(data), "a picture")
        pixels = np.array(image)
    if pixels.ndim != axis_count:
        raise ValueError(f"a picture with {pixels.ndim} axes instead of {axis_count}")
    return pixels
