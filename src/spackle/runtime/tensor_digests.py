"""Recognise damage in values with tensors, whatever file holds them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from spackle.runtime.digests import DIGEST_KEY, unsigned

NO_TEXTS: Mapping[str, str] = {}


def signed_tensors(tensors: Mapping[str, Tensor], texts: Mapping[str, str] = NO_TEXTS) -> bytes:
    """The content of a safetensors file that `read_signed_tensors` checks.

    Args:
        tensors: by name.
        texts: further values by name, which are no tensors' names.
    """
    digest = tree_digest({**tensors, **texts})
    return save(dict(tensors), metadata={**texts, DIGEST_KEY: digest})


def read_signed_tensors(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The tensors and texts in a file of `signed_tensors`, by name.

    A file of an older version has no digest, and is read as it is.

    Raises:
        ValueError: a bit has flipped.
        OSError, SafetensorError: the file is missing or broken.
    """
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        texts: dict[str, str] = file.metadata() or {}
    return unsigned({**tensors, **texts}, tree_digest)


def stated_digest(path: str | os.PathLike[str]) -> str | None:
    """The digest that a safetensors file states; None if it states none, as of an older version.

    Raises:
        OSError, SafetensorError: the file is missing or broken.
    """
    with safe_open(path, framework="pt") as file:
        texts: dict[str, str] = file.metadata() or {}
    return texts.get(DIGEST_KEY)


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
