"""Whether tensors are still those that something was made of, with the same values."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

from torch import Tensor

State = tuple[int, int]  # the count of a tensor's changes in place, and where it lies


class Snapshot:
    """Tensors as they are now; they may go when nobody else holds them."""

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        self._seen = [(weakref.ref(tensor), _state(tensor)) for tensor in tensors]

    @staticmethod
    def possible(tensors: Sequence[Tensor]) -> bool:
        """Whether changes of these would be noticed: tensors of inference mode do not count theirs."""
        return not any(tensor.is_inference() for tensor in tensors)

    def shows(self, tensors: Sequence[Tensor]) -> bool:
        """Whether these are the same tensors, unchanged."""
        return len(tensors) == len(self._seen) and all(
            ref() is tensor and state == _state(tensor)
            for (ref, state), tensor in zip(self._seen, tensors, strict=True)
        )


def _state(tensor: Tensor) -> State:
    """What changes when PyTorch changes a tensor in place; a write to its memory by others is not seen."""
    return tensor._version, tensor.data_ptr()
