"""What a stranger's config.json may ask for, checked before a network is built from it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import nn

from spackle.runtime.errors import short_repr

# Every layer is some Python objects, also of a network without weights, so that layers are counted
# before it is built. The largest published models have 48 blocks of layers.
MAX_LAYERS = 1000
LAYER_COUNTS = re.compile(r"layers|depths|blocks|stages")
# No published setting is larger, neither a number of channels nor the side of a picture in pixels.
MAX_SETTING = 65_536
MAX_LIST_LENGTH = 1000
# Weights are stored in two or four bytes, and loaded in four. Some layers need no stored weights.
MAX_BYTES_PER_STORED_BYTE = 4
HARMLESS_WEIGHT_BYTES = 1 << 28  # of a network beside a small file


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raise a ValueError if a network cannot or must not be built from settings.

    They may ask for far too many layers, or name a second model, which would be downloaded.

    Args:
        settings: the content of config.json.
    """
    _check_backbone(settings)
    layer_count = 0
    for key, value in _walk(settings):
        # The settings of parts of the network may name further models.
        if isinstance(value, Mapping):
            _check_backbone(value)
        elif isinstance(value, list) and len(value) > MAX_LIST_LENGTH:
            raise ValueError(f"its config.json has {len(value):,} values for {short_repr(key)}")
        elif isinstance(value, int) and abs(value) > MAX_SETTING:
            raise ValueError(f"its config.json has the value {short_repr(value)} for {key[:40]!a}")
        elif isinstance(value, int) and LAYER_COUNTS.search(key):
            layer_count += value
    if layer_count > MAX_LAYERS:
        raise ValueError(f"its config.json asks for {layer_count:,} layers, at most {MAX_LAYERS:,}")


def check_weight_size(network: nn.Module, folder: Path) -> None:
    """Raise a ValueError if a network is far larger than the files of weights in a folder.

    Args:
        network: on the meta device, where it takes no memory.
        folder: of the model.
    """
    stored_bytes = sum(file.stat().st_size for file in folder.glob("*.safetensors"))
    float_bytes = 4 * sum(parameter.numel() for parameter in network.parameters())
    if float_bytes > max(HARMLESS_WEIGHT_BYTES, MAX_BYTES_PER_STORED_BYTE * stored_bytes):
        needed = f"{float_bytes:,} bytes of weights"
        raise ValueError(f"its config.json asks for {needed}, and its files have {stored_bytes:,}")


def _check_backbone(settings: Mapping[str, Any]) -> None:
    """Raise a ValueError if the settings of a network name another model as a part of it.

    transformers would ask the hub for it, whatever else it is told. With `backbone_config` the
    name alone changes nothing.
    """
    backbone = settings.get("backbone")
    has_own_settings = isinstance(settings.get("backbone_config"), Mapping)
    if isinstance(backbone, str) and not has_own_settings:
        advice = "give a model that is whole, with its backbone_config"
        raise ValueError(f"its config.json names another model, {short_repr(backbone)}: {advice}")


def _walk(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield all values in nested settings, each with the name under which it is found.

    An element of a list has the name of the list.
    """
    remaining: list[tuple[str, Any]] = [("", settings)]
    while remaining:
        name, value = remaining.pop()
        yield name, value
        if isinstance(value, Mapping):
            remaining += [(str(key), child) for key, child in value.items()]
        elif isinstance(value, list):
            remaining += [(name, child) for child in value[: MAX_LIST_LENGTH + 1]]
