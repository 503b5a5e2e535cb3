"""Gaussians stretched along the axes of the world, as SHARP's are on their way to metres."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from spackle.bases.sharp.jacobi import BLOCK, SWEEPS, UPRIGHT, stretch_chunk
from spackle.gaussians import Gaussians, quat_from_matrix, quat_to_matrix
from spackle.threads import run_chunks

GRAIN = 256 * BLOCK  # Gaussians that a thread takes at a time
PAIRS = (0, 1), (0, 2), (1, 2)  # the columns that a sweep turns


def stretch_gaussians(gaussians: Gaussians, stretch: tuple[float, float, float]) -> Gaussians:
    """Map Gaussians by diag(stretch), which turns and reshapes each one.

    With D = diag(stretch), a covariance R S² Rᵀ becomes M Mᵀ with M = D R S. Rotations of M from the right
    leave that as it is; once they have made M's columns orthogonal (one-sided Jacobi), the columns' lengths
    are the new scales and their directions the new axes. The covariance itself is never formed: it would
    square the ratio of the scales, and lose the small ones.

    Args:
        gaussians: N Gaussians; a zero quaternion counts as no rotation.
        stretch: along x, y and z.

    Returns:
        N Gaussians. Scales descend; quats are unit ones with w ≥ 0; opacities and colors are the same
        tensors; the rest is cut off from autograd.
    """
    quats, scales = gaussians.quats.detach(), gaussians.scales.detach()
    plain = any(t.device.type != "cpu" or t.dtype != torch.float32 for t in (quats, scales))
    quats, scales = (plain_stretch if plain else _fast_stretch)(quats, scales, stretch)
    means = gaussians.means.detach()
    return Gaussians(means * _vector(stretch, means), quats, scales, gaussians.opacities, gaussians.colors)


def _fast_stretch(quats: Tensor, scales: Tensor, stretch: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """`plain_stretch` for float32 on the CPU, compiled and in all threads."""
    source = quats.contiguous().numpy(), scales.contiguous().numpy()
    result = np.empty((len(quats), 4), np.float32), np.empty((len(quats), 3), np.float32)
    factors = float(stretch[0]), float(stretch[1]), float(stretch[2])
    run_chunks(lambda start, stop: stretch_chunk(start, stop, *source, factors, *result), len(quats), GRAIN)
    return torch.from_numpy(result[0]), torch.from_numpy(result[1])


def plain_stretch(quats: Tensor, scales: Tensor, stretch: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """The same sweeps as batched operations, for any device and floating dtype; on a GPU nobody waits for them.

    Takes and returns quats [N, 4] and scales [N, 3], as `stretch_gaussians` describes them.
    """
    dtype = torch.promote_types(scales.dtype, torch.float32)
    # In units of each Gaussian's largest scale no square overflows, and none that matters underflows.
    unit = scales.abs().amax(1, keepdim=True).to(dtype).clamp(min=torch.finfo(dtype).tiny)
    matrix = quat_to_matrix(quats.to(dtype)) * (scales / unit)[:, None] * _vector(stretch, unit)[:, None]
    columns = list(matrix.unbind(2))
    for _ in range(SWEEPS):
        for i, j in PAIRS:
            columns[i], columns[j] = _plain_turn(columns[i], columns[j])
    matrix = torch.stack(columns, 2)
    sizes, order = torch.linalg.vector_norm(matrix, dim=1).sort(dim=1, descending=True, stable=True)
    a, b, _ = matrix.gather(2, order[:, None].expand_as(matrix)).unbind(2)
    rotation = _plain_frame(a, b)
    return quat_from_matrix(rotation).to(quats.dtype), (sizes * unit).to(scales.dtype)


def _vector(numbers: tuple[float, float, float], like: Tensor) -> Tensor:
    """`like.new_tensor(numbers)` without a copy to the device, for which the processor would wait."""
    return torch.stack([like.new_full((), number) for number in numbers])


def _plain_turn(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate columns [N, 3] in their plane, by 45° at most, so that they become orthogonal."""
    skew, lead = 2 * (p * q).sum(1, keepdim=True), (q * q - p * p).sum(1, keepdim=True)
    # hypot, because a small lead's square would underflow.
    tangent = skew / (lead.abs() + torch.hypot(lead, skew)).clamp(min=torch.finfo(lead.dtype).tiny)
    tangent = torch.where(lead < 0, -tangent, tangent)
    cosine = 1 / (1 + tangent * tangent).sqrt()
    sine = tangent * cosine
    return cosine * p - sine * q, sine * p + cosine * q


def _plain_frame(a: Tensor, b: Tensor) -> Tensor:
    """Rotations [N, 3, 3] with the first axis along a and the second nearly along b, any where they are zero."""
    axes = torch.eye(3, dtype=a.dtype, device=a.device)
    a, b = normalize(a, dim=1, eps=torch.finfo(a.dtype).tiny), normalize(b, dim=1, eps=torch.finfo(a.dtype).tiny)
    a = torch.where(a.any(1, keepdim=True), a, axes[0])
    c = torch.linalg.cross(a, b)
    usable = (c * c).sum(1, keepdim=True) > UPRIGHT
    c = normalize(torch.where(usable, c, torch.linalg.cross(a, axes[a.abs().argmin(1)])), dim=1)
    return torch.stack([a, torch.linalg.cross(c, a), c], dim=2)
