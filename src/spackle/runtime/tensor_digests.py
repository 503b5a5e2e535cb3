"""Recognise damage in values with tensors, whatever file holds them."""

from __future__ import annotations

import hashlib
from typing import Any

import torch
from torch import Tensor


def tree_digest(value: Any) -> str:
    """SHA-256, in hexadecimal digits, of a tree of dicts, lists, tensors and plain values.

    It depends on what a reader gets back, not on how a file stores it: the order of keys does not
    matter, and neither do a tensor's device and memory layout.
    """
    sha256 = hashlib.sha256()
    _add(sha256, value)
    return sha256.hexdigest()


def _add(sha256: Any, value: Any) -> None:
    """Add a value to a digest; what kind it is and how long is added first, so none is mistaken."""
    if isinstance(value, Tensor):
        plain = value.detach().cpu().contiguous()
        sha256.update(f"tensor {plain.dtype} {tuple(plain.shape)};".encode())
        # The numbers' bytes, of any type; a tensor without axes has none to view as bytes.
        sha256.update(plain.reshape(-1).view(torch.uint8).numpy())
    elif isinstance(value, dict):
        sha256.update(f"dict {len(value)};".encode())
        for key in sorted(value, key=repr):
            _add(sha256, key)
            _add(sha256, value[key])
    elif isinstance(value, (list, tuple)):
        sha256.update(f"list {len(value)};".encode())
        for item in value:
            _add(sha256, item)
    else:
        text = repr(value).encode()
        sha256.update(f"{type(value).__name__} {len(text)};".encode() + text)
