"""A network while it learns: its weights, their average over the steps, and the optimiser between them."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import clip_grad_norm_

from spackle.errors import InputError
from spackle.training.checkpoint import Checkpoint
from spackle.training.ranks import Ranks
from spackle.training.recipe import OptimRecipe
from spackle.training.schedule import ema_decay, learning_rate


def even(name: str) -> float:
    """One learning rate for all weights, whatever their names."""
    return 1.0


class Learner:
    """All that a step changes."""

    def __init__(
        self,
        network: nn.Module,
        optim: OptimRecipe,
        device: torch.device,
        ranks: Ranks,
        pace: Callable[[str], float] = even,
    ) -> None:
        """Before the first step.

        Args:
            network: the first weights; those that ask for gradients are trained in place.
            optim: learning rate, decay and the like.
            device: where it learns.
            ranks: this process among those that share the gradients.
            pace: a weight's name to a factor on its learning rate.
        """
        self.optim, self.device = optim, device
        self.network: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        learning: dict[float, list[nn.Parameter]] = {}
        for name, weight in network.named_parameters():
            if weight.requires_grad:
                learning.setdefault(pace(name), []).append(weight)
        self.paces = list(learning)
        groups = [{"params": weights} for weights in learning.values()]
        self.optimizer = torch.optim.AdamW(groups, optim.lr, betas=optim.betas, weight_decay=optim.weight_decay)
        # Gradients are averaged over the processes while they are computed.
        self.wrapped: nn.Module = DistributedDataParallel(network) if ranks.count > 1 else network

    def resume(self, checkpoint: Checkpoint, folder: Path) -> None:
        """Go on with what a checkpoint holds; InputError where its network is another one, naming its folder."""
        expected = {name: tensor.shape for name, tensor in self.network.state_dict().items()}
        for tensors in (checkpoint.network, checkpoint.average):
            found = {name: tensor.shape for name, tensor in tensors.items()}
            if wrong := sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name)):
                raise InputError(
                    f"{folder}: its checkpoint is of another network ({len(wrong)} tensors differ, e.g. {wrong[0]}): "
                    "choose another with -o, or --overwrite to start anew"
                )
        self.network.load_state_dict(checkpoint.network)
        self.average.load_state_dict(checkpoint.average)
        self.optimizer.load_state_dict(checkpoint.optimizer)

    def adding_up(self, last: bool) -> contextlib.AbstractContextManager[None]:
        """Around each part of a step: the processes put their gradients together in the last one alone."""
        if last or not isinstance(self.wrapped, DistributedDataParallel):
            return contextlib.nullcontext()
        return self.wrapped.no_sync()

    def forget_gradients(self) -> None:
        """Before the first part."""
        self.optimizer.zero_grad(set_to_none=True)

    def clip(self) -> Tensor:
        """[] the gradient's norm, which is no longer than `optim.clip` hereafter."""
        return clip_grad_norm_(self.network.parameters(), self.optim.clip)

    def update(self, step: int) -> float:
        """Move the weights along their gradients, and the average after them; returns the learning rate."""
        rate = learning_rate(step, self.optim)
        for group, pace in zip(self.optimizer.param_groups, self.paces, strict=True):
            group["lr"] = pace * rate
        self.optimizer.step()
        decay = ema_decay(step, self.optim.ema)
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - decay)
        return rate

    def state(self) -> dict[str, Any]:
        """The fields of a `Checkpoint` that are here."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
