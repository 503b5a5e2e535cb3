"""Sets of Gaussians as the GPU needs them, and what is remembered of them there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.gaussians import Gaussians
from spackle.render.unchanged import Snapshot

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))  # gsplat's order of a symmetric matrix' six values


@dataclasses.dataclass(frozen=True)
class Material:
    """A set on the GPU, float32."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 6]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3] linear

    @staticmethod
    def of(part: Gaussians, device: torch.device) -> Material:
        """Bring a set there; what is not finite becomes a transparent point: to take it out would wait for the GPU."""
        there = [tensor.to(device, torch.float32) for tensor in part.tensors]
        finite = torch.stack(
            [t.detach().isfinite() if t.ndim == 1 else t.detach().isfinite().all(-1) for t in there]
        ).all(0)
        usable = Gaussians(*(torch.where(finite if t.ndim == 1 else finite[:, None], t, 0) for t in there))
        return Material(usable.means, usable.covariances()[:, UPPER[0], UPPER[1]], usable.opacities, usable.colors)


@dataclasses.dataclass(frozen=True)
class Projection:
    """A set as C cameras see it."""

    radii: Tensor  # [C, N, 2] int; 0 where nothing is seen
    means2d: Tensor  # [C, N, 2] pixels; anything where nothing is seen, as the rest
    depths: Tensor  # [C, N]
    conics: Tensor  # [C, N, 3]

    @staticmethod
    def joined(parts: Sequence[Projection]) -> Projection:
        """Of several sets, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return Projection(*(torch.cat(tensors, 1) for tensors in zip(*(part.tensors for part in parts), strict=True)))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All fields."""
        return self.radii, self.means2d, self.depths, self.conics


@dataclasses.dataclass
class _Entry:
    snapshot: Snapshot
    material: Material
    key: Hashable = None
    projection: Projection | None = None


class SetStore:
    """Each set's material, and its last projection: a scene travels once, and is projected once a camera.

    Both go when the set's tensors go. A set that asks for a gradient is not remembered: it changes at every step.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._entries = WeakTensorKeyDictionary()

    def material(self, part: Gaussians) -> Material:
        """The set on the GPU."""
        entry = self._entry(part)
        return Material.of(part, self.device) if entry is None else entry.material

    def projection(self, part: Gaussians, key: Hashable, make: Callable[[Material], Projection]) -> Projection:
        """What `make` makes of the set's material; not again for the key of the last call. None is no such key."""
        entry = self._entry(part)
        if entry is None or key is None:
            return make(self.material(part))
        if entry.projection is None or entry.key != key:
            with torch.inference_mode(False):
                entry.key, entry.projection = key, make(entry.material)
        return entry.projection

    def _entry(self, part: Gaussians) -> _Entry | None:
        """What is remembered of a set, made where it is new or has changed; None for one that must not be."""
        if any(tensor.requires_grad for tensor in part.tensors) or not Snapshot.possible(part.tensors):
            return None
        entry: _Entry | None = self._entries.get(part.means)  # type: ignore[no-untyped-call]
        if entry is None or not entry.snapshot.shows(part.tensors):
            with torch.inference_mode(False):  # who asks next may want gradients of something drawn with it
                entry = _Entry(Snapshot(part.tensors), Material.of(part, self.device))
            self._entries[part.means] = entry
        return entry
