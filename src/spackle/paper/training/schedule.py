"""What happens at which step: learning rate, averaging of weights, choice of samples."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spackle.paper.training.recipe import OptimRecipe

# Early on, the average of the weights keeps the share (step + 1) / (step + 10), and so soon forgets
# the initial weights.
EMA_WARMUP_STEPS = 10
K = TypeVar("K")
V = TypeVar("V")


def learning_rate(step: int, optim: OptimRecipe) -> float:
    """The learning rate at a step, counted from 0: a linear warm-up, then half a cosine.

    This is the paper's schedule ("Training Details and Loss Weights"):

        lr · (step + 1) / warmup                                     for step < warmup,
        min_lr + (lr - min_lr) · (1 + cos(π · progress)) / 2         after that,

    where progress grows from 0 to 1 between the end of the warm-up and the last step.
    """
    if step < optim.warmup:
        return optim.lr * (step + 1) / optim.warmup
    decay_steps = max(1, optim.steps - optim.warmup)  # not 0, also if the warm-up is the whole run
    progress = min(1.0, (step - optim.warmup) / decay_steps)
    return optim.min_lr + (optim.lr - optim.min_lr) * (1 + math.cos(math.pi * progress)) / 2


def ema_decay(step: int, decay: float) -> float:
    """The share that the old average keeps when the weights of a step join their moving average.

    The new weights get the rest. The share grows from 1/10 at step 0 towards `decay`, so that the
    average soon forgets the untrained weights.
    """
    return min(decay, (step + 1) / (step + EMA_WARMUP_STEPS))


def samples_of_step(
    step: int, count: int, batch: int, seed: int, rank: int = 0, ranks: int = 1
) -> list[int]:
    """Indices of the training samples that one process uses at a step.

    The samples follow each other in epochs. Each epoch has every sample once, in a random order; a
    batch may begin in one epoch and end in the next. The result depends on the arguments alone, so
    that a resumed run uses the same samples.

    Args:
        step: the number of the step, counted from 0.
        count: number of samples; the indices are below this number.
        batch: samples of a step, over all processes.
        seed: determines the order of each epoch.
        rank: the number of the process, whose samples are returned.
        ranks: number of processes; they divide each batch evenly.
    """
    # Positions count samples over all steps. The processes take neighbouring parts of the batch.
    samples_per_rank = batch // ranks
    first = step * batch + rank * samples_per_rank

    indices = []
    for position in range(first, first + samples_per_rank):
        epoch = position // count
        indices.append(int(order_of_epoch(seed, epoch, count)[position % count]))
    return indices


@functools.lru_cache(
    maxsize=2
)  # a batch touches at most the end of one epoch and the start of the next
def order_of_epoch(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """The order of the samples in an epoch: a random permutation [count] of 0 to count - 1."""
    return np.random.default_rng([seed, epoch]).permutation(count)


def prefetch(make: Callable[[K], V], keys: Iterable[K], threads: int) -> Generator[V, None, None]:
    """Yield `make(key)` for each key, in order; threads compute the next values in advance.

    At most one value for each thread waits to be used, because more values would only take memory.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="batches") as pool:
        pending = deque[Future[V]]()
        for key in keys:
            pending.append(pool.submit(make, key))
            # The threads are busy with the next values now, so the oldest value may be waited for.
            if len(pending) > threads:
                yield pending.popleft().result()
        for future in pending:
            yield future.result()
