"""Images and Gaussians as bytes: small, the same every time, and without a loss that anybody sees.

| what | how | error |
|---|---|---|
| colours | PNG, 8 bits a channel, sRGB | 1/510 |
| mask | PNG, 8 bits: 255 uncovered, 0 covered | none |
| opacity | PNG, 16 bits: opacity · 65535, never across the mask's threshold | 1/65535 |
| depth | PNG, 16 bits: 0 nothing, else 1 + 65534 · log(z / near) / log(far / near), near and far stored with the view | log(far / near) / 131068, relative: 1e-4 for far / near = 490,000 |
| Gaussians | safetensors: means float32; quats and colours float16; opacities · 65535 and the logarithm of the scales in 16 bits | below 1e-3 of a pixel |
"""  # noqa: E501

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from safetensors import SafetensorError
from safetensors.numpy import load, save
from torch import Tensor
from torch.nn.functional import normalize

from spackle.formats.png import to_bytes
from spackle.gaussians import Gaussians

COMPRESSION = 1  # zlib's: 6 takes three times as long and saves a tenth
DEEPEST = 65535
SMALLEST_SCALE = 1e-30


def encode_rgb(rgb: Tensor) -> bytes:
    """sRGB [H, W, 3] in 0..1 as PNG."""
    return _png(to_bytes(rgb).numpy())


def decode_rgb(data: bytes) -> Tensor:
    """[H, W, 3] in 0..1."""
    return torch.from_numpy(_pixels(data, 3)).float() / 255


def encode_mask(mask: Tensor) -> bytes:
    """[H, W] bool as PNG: 255 where true."""
    return _png(mask.cpu().numpy().astype(np.uint8) * np.uint8(255))


def decode_mask(data: bytes) -> Tensor:
    """[H, W] bool."""
    return torch.from_numpy(_pixels(data, 2)) > 127


def encode_alpha(alpha: Tensor, mask: Tensor, threshold: float) -> bytes:
    """Opacity [H, W] in 0..1 as PNG. What is below `threshold`, as `mask` has it, stays below, and the rest not."""
    codes = (alpha.detach().cpu().double() * DEEPEST).round().clamp(0, DEEPEST)
    last = math.ceil(threshold * DEEPEST) - 1  # the greatest code below the threshold
    codes = torch.where(mask.cpu(), codes.clamp_max(last), codes.clamp_min(last + 1))
    return _png(codes.numpy().astype(np.uint16))


def decode_alpha(data: bytes) -> Tensor:
    """[H, W] in 0..1."""
    return torch.from_numpy(_pixels(data, 2).astype(np.float64) / DEEPEST).float()


def encode_depth(depth: Tensor, alpha: Tensor) -> tuple[bytes, tuple[float, float]]:
    """Expected z [H, W] as PNG, and the (near, far) that `decode_depth` needs. Nothing is known where alpha is 0."""
    z = depth.detach().cpu().double().numpy()
    known = (alpha.detach().cpu().numpy() > 0) & np.isfinite(z) & (z > 0)
    near, far = (float(z[known].min()), float(z[known].max())) if known.any() else (1.0, 1.0)
    codes = np.zeros(z.shape, np.uint16)
    span = max(math.log(far / near), 1e-12)
    codes[known] = 1 + np.round((DEEPEST - 1) * np.log(z[known] / near) / span)
    return _png(codes), (near, far)


def decode_depth(data: bytes, near: float, far: float) -> Tensor:
    """[H, W], 0 where nothing is known."""
    codes = _pixels(data, 2).astype(np.float64)
    z = near * np.exp((codes - 1) / (DEEPEST - 1) * math.log(far / near))
    return torch.from_numpy(np.where(codes > 0, z, 0.0)).float()


def encode_gaussians(gaussians: Gaussians) -> bytes:
    """Gaussians as safetensors, 34 bytes each."""
    means, quats, scales, opacities, colors = (t.detach().cpu().float() for t in gaussians.tensors)
    logs = scales.double().clamp_min(SMALLEST_SCALE).log()
    low, high = (float(logs.min()), float(logs.max())) if len(means) else (0.0, 0.0)
    steps = ((logs - low) / max(high - low, 1e-12) * DEEPEST).round()
    arrays: dict[str, NDArray[Any]] = {
        "means": means.numpy(),
        "quats": normalize(quats, dim=-1).half().numpy(),
        "scales": steps.numpy().astype(np.uint16),
        "scale_logs": np.array([low, high]),
        "opacities": (opacities.double() * DEEPEST).round().clamp(0, DEEPEST).numpy().astype(np.uint16),
        "colors": colors.half().numpy(),
    }
    return save(arrays)


def decode_gaussians(data: bytes) -> Gaussians:
    """What `encode_gaussians` wrote, as float32; ValueError where it is something else."""
    try:
        arrays = load(data)
        low, high = arrays["scale_logs"].tolist()
        scales = np.exp(low + arrays["scales"].astype(np.float64) / DEEPEST * max(high - low, 1e-12))
        opacities = arrays["opacities"].astype(np.float64) / DEEPEST
        columns = (arrays["means"], arrays["quats"], scales, opacities, arrays["colors"])
        return Gaussians(*(torch.from_numpy(np.ascontiguousarray(column)).float() for column in columns))
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"no Gaussians: {error}") from error


def _png(pixels: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG", compress_level=COMPRESSION)
    return file.getvalue()


def _pixels(data: bytes, axes: int) -> NDArray[Any]:
    """The pixels of a PNG of ours; ValueError where it is none."""
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            pixels = np.array(image)
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"no picture: {error}") from error
    if pixels.ndim != axes:
        raise ValueError(f"a picture with {pixels.ndim} axes instead of {axes}")
    return pixels
