"""What step s does, as pure functions of s: its learning rate, its samples, and the weights' average."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from spackle.training.recipe import OptimRecipe

EMA_START = 10  # the average forgets the first, bad weights this quickly: decay (s + 1) / (s + 10)


def learning_rate(step: int, optim: OptimRecipe) -> float:
    """Linear warm-up, then a cosine down to `min_lr` ("Training Details and Loss Weights").

    Args:
        step: from 0 up.
        optim: lr, min_lr, warmup and steps count.
    """
    if step < optim.warmup:
        return optim.lr * (step + 1) / optim.warmup
    done = min(1.0, (step - optim.warmup) / max(1, optim.steps - optim.warmup))
    return optim.min_lr + (optim.lr - optim.min_lr) * (1 + math.cos(math.pi * done)) / 2


def ema_decay(step: int, decay: float) -> float:
    """How much of the average stays at a step."""
    return min(decay, (step + 1) / (step + EMA_START))


def samples_of_step(step: int, count: int, batch: int, seed: int, rank: int = 0, ranks: int = 1) -> list[int]:
    """Which of `count` samples a process sees at a step: nothing but the arguments decides.

    Every epoch is a permutation of all samples; a batch may end one and begin the next. However many
    processes there are, they share the same global batch.

    Args:
        step: from 0 up.
        count: samples in all.
        batch: of all processes together; a multiple of `ranks`.
        seed: of the permutations.
        rank: the process, from 0.
        ranks: how many there are.

    Raises:
        ValueError: a batch that cannot be divided.
    """
    share, rest = divmod(batch, ranks)
    if rest:
        raise ValueError(f"a batch of {batch} cannot be divided between {ranks} processes")
    first = step * batch + rank * share
    return [int(_epoch(seed, place // count, count)[place % count]) for place in range(first, first + share)]


@functools.lru_cache(maxsize=2)
def _epoch(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)
