"""Base of all trainers: seeds, batches, optimiser, learning rate, and checkpoints.

Everything random in step s (which samples, timesteps, noise, dropout) follows from ``(seed, s)``; a training that is stopped
and resumed therefore ends bit by bit as if it had not been.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.training_state import read_checkpoint, write_checkpoint

__all__ = ["StepConfig", "Trainer", "batch_indices", "checksum", "step_seed"]

UNLOGGED = "unlogged"  # of a checkpoint's fields; earlier ones lack it
LENGTH = frozenset({"max_steps", "epochs", "max_updates"})  # of a header's keys: these may differ


class StepConfig(Protocol):
    """Options of an optimiser step, common to all trainings.

    Attributes:
        batch_size: samples in a step.
        max_grad_norm: gradient norm clip; 0 does not clip.
        seed: fixes everything random.
    """

    batch_size: int
    max_grad_norm: float
    seed: int


class Trainer(ABC):
    """Base of all trainers; subclasses define the losses of a batch.

    Args:
        module: the module to train, in place.
        optimizer: of its parameters, with the peak learning rate.
        config: of a step.
        num_samples: samples to train on; a batch is drawn as their indices.
        total: optimiser steps to take; the cosine of the learning rate ends there.
        warmup_steps: steps of linear warm-up.

    Attributes:
        step: optimiser steps taken.
        total: optimiser steps to take.
        unlogged: what the steps since the last log entry returned; in checkpoints, so that an entry is of all its steps.

    Examples:
        >>> class Regression(Trainer):
        ...     def batch_losses(self, index):
        ...         x = index[:, None].float()
        ...         return {"loss": (self.module(x) - 2 * x).abs().mean()}
        ...
        ...     def validate(self):
        ...         return {}
        ...
        ...     def header(self):
        ...         return {}
        >>> from types import SimpleNamespace
        >>> module, config = nn.Linear(1, 1), SimpleNamespace(batch_size=4, max_grad_norm=0.0, seed=0)
        >>> adam = torch.optim.Adam(module.parameters(), lr=0.1)
        >>> trainer = Regression(module, adam, config, num_samples=8, total=50, warmup_steps=5)
        >>> losses = [trainer.train_step()["loss"] for _ in range(50)]
        >>> losses[-1] < losses[0]
        True
    """

    def __init__(
        self,
        module: nn.Module,
        optimizer: torch.optim.Optimizer,
        config: StepConfig,
        *,
        num_samples: int,
        total: int,
        warmup_steps: int,
    ) -> None:
        self.module, self.config = module, config
        self.step, self.total, self.warmup_steps = 0, total, warmup_steps
        self._optimizer, self._num_samples = optimizer, num_samples
        self.unlogged: list[dict[str, float]] = []
        self._lr_scheduler = self.make_lr_scheduler(optimizer)

    @abstractmethod
    def batch_losses(self, index: Tensor) -> dict[str, Tensor]:
        """Return scalars for the samples ``index``, i64 [B]: ``"loss"``, which is minimised, and others to log."""

    @abstractmethod
    def validate(self) -> dict[str, float]:
        """Return metrics of the module on held-out samples; empty if none are held out."""

    @abstractmethod
    def header(self) -> dict[str, dict[str, Any]]:
        """Return plain values that a checkpoint and the training that resumes it must agree on."""

    def state(self) -> dict[str, Any]:
        """Return a checkpoint's content without the header."""
        return {
            "step": self.step,
            "network": self.module.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            UNLOGGED: self.unlogged,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Load a state that `state` returned."""
        self.module.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.step, self.unlogged = state["step"], state.get(UNLOGGED, [])
        self._lr_scheduler = self.make_lr_scheduler(self._optimizer)

    def make_lr_scheduler(self, optimizer: torch.optim.Optimizer) -> LambdaLR:
        """Return the learning-rate schedule from `step` on: linear warm-up, cosine to zero, zero beyond `total`.

        diffusers' cosine of the same shape rises again there.
        """
        decay = max(1, self.total - self.warmup_steps)

        def factor(step: int) -> float:
            if step < self.warmup_steps:
                return step / self.warmup_steps
            return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - self.warmup_steps) / decay)))

        return LambdaLR(optimizer, factor, last_epoch=self.step - 1)

    @property
    def lr(self) -> float:
        """Learning rate of the next step."""
        return self._lr_scheduler.get_last_lr()[0]

    def train_step(self) -> dict[str, float]:
        """Take one optimiser step and return its batch's scalars, see `batch_losses`.

        Raises:
            FloatingPointError: if the loss is not finite; the weights are then those of the step before.
        """
        torch.manual_seed(step_seed(self.config.seed, self.step))
        index = batch_indices(self._num_samples, self.config.batch_size, self.step, self.config.seed)
        self.module.train()
        self._optimizer.zero_grad(set_to_none=True)
        losses = self.batch_losses(index)
        if not math.isfinite(value := losses["loss"].item()):
            raise FloatingPointError(f"step {self.step}: loss is {value}")
        losses["loss"].backward()
        if self.config.max_grad_norm > 0:
            torch.nn.utils.clip_grad_norm_(self.module.parameters(), self.config.max_grad_norm)
        self._optimizer.step()
        self._lr_scheduler.step()
        self.step += 1
        return {name: scalar.item() for name, scalar in losses.items()}

    def save(self, path: str | Path) -> None:
        """Write a checkpoint atomically: a kill leaves the old file or the new one."""
        write_checkpoint(path, self.header() | self.state())

    def load(self, path: str | Path) -> None:
        """Resume from a checkpoint, even of a training with another length. Nothing in the file is executed.

        The learning rate goes on along the cosine that ends at `total`: one that is extended ends otherwise than one that was
        as long from its first step.

        Raises:
            FileNotFoundError: if there is none.
            InputError: if it is no checkpoint of this class, its header is another but for the length, or it is past `total`.
        """
        header = self.header()
        fields = header.keys() | self.state().keys()
        state = read_checkpoint(path, fields, header, optional={UNLOGGED}, free=LENGTH)
        if (taken := state["step"]) > self.total:
            raise InputError(
                f"{path}: expected at most {self.total} steps, as asked for, got {taken}; ask for more or choose another out"
            )
        self.load_state(state)


def checksum(values: Tensor) -> float:
    """Return the exact sum, rounded once: equal on every machine and for any number of threads.

    Pictures are summed in place, by numpy, which is sixteen times as fast with bytes as torch.

    >>> checksum(torch.tensor([1e16, 1.0, -1e16], dtype=torch.float64))
    1.0
    >>> checksum(torch.tensor([255, 255], dtype=torch.uint8))
    510.0
    """
    if not values.is_floating_point():
        return float(values.numpy().sum(dtype=np.int64))
    return math.fsum(values.flatten().tolist())


def step_seed(seed: int, step: int) -> int:
    """Return the seed of torch's global generator for ``step``; distinct for all steps of a training.

    torch's CPU generator reads only the low 32 bits of a seed, so both numbers have to be mixed into those.

    Examples:
        >>> step_seed(0, 5), step_seed(1, 5) == step_seed(0, 5)
        (5, False)
    """
    return (seed * 0x9E3779B1 + step) % 2**32


def batch_indices(num_samples: int, batch_size: int, step: int, seed: int) -> Tensor:
    """Return the samples of ``step``, i64 [batch_size].

    Every epoch is a permutation of all samples that follows from (seed, epoch). Batches run on over the end
    of an epoch, so that every sample is used equally often.

    Examples:
        >>> torch.cat([batch_indices(6, 3, step, seed=0) for step in range(2)]).sort().values.tolist()
        [0, 1, 2, 3, 4, 5]
    """
    position = torch.arange(step * batch_size, (step + 1) * batch_size)
    epoch, offset = position // num_samples, position % num_samples
    index = torch.empty_like(offset)
    for number in epoch.unique().tolist():
        generator = torch.Generator().manual_seed(step_seed(seed, number))
        chosen = epoch == number
        index[chosen] = torch.randperm(num_samples, generator=generator)[offset[chosen]]
    return index
