"""Operations of networks, counted by PyTorch while they run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from spackle.evaluation.suite.values import Need


def counted(call: Callable[[], Any]) -> float:
    """Operations of the products, convolutions and attention in a call: two for each multiplication and addition."""
    attention = getattr(torch.ops.aten, "_scaled_dot_product_flash_attention_for_cpu", None)
    extra = {} if attention is None else {attention: _attention}  # which PyTorch knows on GPUs alone
    with FlopCounterMode(display=False, custom_mapping=extra) as counter:
        call()
    return float(counter.get_total_flops())


def network_need(network: nn.Module, call: Callable[[], Any], kind: str) -> Need:
    """Of a call of a network: its operations, and to read its weights once, in what it computes in.

    Args:
        network: whose weights are read.
        call: runs it, once.
        kind: "fp32" or "bf16".
    """
    size = 2 if kind == "bf16" else 4
    return Need(float(size * sum(p.numel() for p in network.parameters())), {kind: counted(call)})


def _attention(query: Any, key: Any, value: Any, *rest: Any, out_shape: Any = None, **more: Any) -> int:
    operations: int = sdpa_flop_count(query, key, value)  # type: ignore[no-untyped-call]
    return operations
