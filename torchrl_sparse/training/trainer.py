"""Training a network on demonstrations: weights, their average, the optimiser and the step in one resumable object.

Everything random in step s (which windows, timesteps, noise, dropout) follows from ``(seed, s)``; a training
that is stopped and resumed therefore continues bit by bit as if it had not been.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from diffusers.training_utils import EMAModel
from torch import Tensor, nn

from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.training_state import read_checkpoint

__all__ = ["TrainConfig", "Trainer", "batch_indices", "checksum", "split_windows", "step_seed"]


@dataclass(frozen=True)
class TrainConfig:
    """How to train; defaults as published for low-dimensional robomimic (arXiv:2303.04137, Table VII).

    Attributes:
        max_steps: optimiser steps; the cosine schedule ends there.
        batch_size: windows in a step.
        n_action_steps: actions executed of a chunk; decides how far windows reach over an episode's end.
        lr: peak learning rate.
        lr_warmup_steps: steps of linear warm-up.
        weight_decay: of Linear and attention weights.
        max_grad_norm: gradient norm clip; 0 does not clip, as published.
        ema_power, ema_max_decay: of the weight average, decay ``min(max, 1 - (1 + s) ** -power)``.
        precision: "fp32", or "bf16" (autocast; the weights and the optimiser stay fp32).
        val_ratio: share of the episodes, the last ones, that are not trained on.
        seed: fixes everything random.
    """

    max_steps: int
    batch_size: int = 256
    n_action_steps: int = 8
    lr: float = 1e-4
    lr_warmup_steps: int = 1000
    weight_decay: float = 1e-3
    max_grad_norm: float = 0.0
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    precision: Literal["fp32", "bf16"] = "fp32"
    val_ratio: float = 0.02
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_steps < 1 or self.batch_size < 1:
            raise ValueError(
                f"expected max_steps and batch_size >= 1, "
                f"got max_steps={self.max_steps}, batch_size={self.batch_size}"
            )
        if self.precision not in ("fp32", "bf16"):
            raise ValueError(f'precision: expected "fp32" or "bf16", got {self.precision!r}')
        if not 0 <= self.val_ratio < 1:
            raise ValueError(f"val_ratio: expected a share in [0, 1), got {self.val_ratio}")


class Trainer:
    """Base of trainings on windows of demonstrations; a subclass says what the loss of a batch is.

    Args:
        trained: the module, trained in place.
        config: how to train.
        groups: parameter groups of the optimiser.
        train_rows: i64 [W, H], rows of the training windows.
        val_rows: the same of the held-out ones, or None.

    Attributes:
        step: optimiser steps taken.
        lr: the learning rate of the next step.
    """

    def __init__(
        self,
        trained: nn.Module,
        config: TrainConfig,
        groups: list[dict[str, Any]],
        train_rows: Tensor,
        val_rows: Tensor | None,
    ) -> None:
        self.trained, self.config = trained, config
        self.train_rows, self.val_rows = train_rows, val_rows
        self._ema = EMAModel(
            trained.parameters(),
            decay=config.ema_max_decay,
            power=config.ema_power,
            update_after_step=0,
            use_ema_warmup=True,
            foreach=True,
        )
        self._optimizer = torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.95), fused=True)
        self.step = 0
        self._set_schedule()

    def batch_loss(self, rows: Tensor) -> Tensor:
        """The loss, a scalar, of windows ``rows`` i64 [B, H]."""
        raise NotImplementedError

    def header(self) -> dict[str, dict]:
        """What must be equal when a training goes on: ``"config"``, ``"network_config"`` and ``"data"``, plain values."""
        raise NotImplementedError

    @property
    def lr(self) -> float:
        return self._schedule.get_last_lr()[0]

    def train_step(self) -> float:
        """One optimiser step; returns its loss.

        Raises:
            FloatingPointError: if the loss is not finite; the weights are then those of the step before.
        """
        torch.manual_seed(step_seed(self.config.seed, self.step))
        index = batch_indices(len(self.train_rows), self.config.batch_size, self.step, self.config.seed)
        self.trained.train()
        self._optimizer.zero_grad(set_to_none=True)
        loss = self.batch_loss(self.train_rows[index])
        if not math.isfinite(value := loss.item()):
            raise FloatingPointError(f"step {self.step}: loss is {value}")
        loss.backward()
        if self.config.max_grad_norm > 0:
            torch.nn.utils.clip_grad_norm_(self.trained.parameters(), self.config.max_grad_norm)
        self._optimizer.step()
        self._schedule.step()
        self._ema.step(self.trained.parameters())
        self.step += 1
        return value

    @torch.no_grad()
    def validate(self, max_windows: int = 512) -> float:
        """Loss of the averaged weights on held-out episodes and fixed noise; nan if none is held out."""
        if self.val_rows is None:
            return float("nan")
        self.trained.eval()
        with torch.random.fork_rng(devices=[]), self._averaged_weights():
            torch.manual_seed(self.config.seed)
            rows = self.val_rows[torch.randperm(len(self.val_rows))[:max_windows]]
            return self.batch_loss(rows.repeat(math.ceil(max_windows / len(rows)), 1)).item()

    def averaged(self) -> nn.Module:
        """A copy of the module with the averaged weights, in evaluation mode."""
        module = copy.deepcopy(self.trained).eval()
        self._ema.copy_to(module.parameters())
        return module

    def save(self, path: str | Path) -> None:
        """Writes a checkpoint. A kill leaves the old file or the new one, never a part of one."""
        with atomic_path(Path(path)) as temporary:
            torch.save(self._state(), temporary)

    def load(self, path: str | Path) -> None:
        """Continues from a checkpoint. Nothing in the file is executed.

        Raises:
            ValueError: if it is no checkpoint of this class, or was made with another network, data set or
                configuration.
        """
        header = self.header()
        state = read_checkpoint(path, {*header, "step", "network", "ema", "optimizer"}, header)
        self.trained.load_state_dict(state["network"])
        self._ema.load_state_dict(state["ema"])
        self._ema.to(next(self.trained.parameters()).device)
        self._optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]
        self._set_schedule()

    @contextmanager
    def _averaged_weights(self) -> Iterator[None]:
        self._ema.store(self.trained.parameters())
        self._ema.copy_to(self.trained.parameters())
        try:
            yield
        finally:
            self._ema.restore(self.trained.parameters())

    def _set_schedule(self) -> None:
        for group in self._optimizer.param_groups:
            group["initial_lr"] = self.config.lr
        self._schedule = get_cosine_schedule_with_warmup(
            self._optimizer, self.config.lr_warmup_steps, self.config.max_steps, last_epoch=self.step - 1
        )

    def _state(self) -> dict[str, Any]:
        return {
            **self.header(),
            "step": self.step,
            "network": self.trained.state_dict(),
            "ema": self._ema.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }


def split_windows(
    demos: Demonstrations, sizes: tuple[int, int, int], val_ratio: float
) -> tuple[Tensor, Tensor | None]:
    """Training windows, and those of the last ``val_ratio`` of the episodes, None for a ratio of 0.

    Args:
        demos: the demonstrations.
        sizes: horizon, observation steps and action steps of a window, see `Demonstrations.window_rows`.
        val_ratio: share of the episodes.

    Raises:
        ValueError: if that leaves no episode to train on.
    """
    num_val = math.ceil(val_ratio * len(demos))
    if num_val >= len(demos):
        raise ValueError(f"val_ratio {val_ratio} of {len(demos)} episodes leaves none to train on")
    split = len(demos) - num_val
    held_out = demos.window_rows(*sizes, range(split, len(demos))) if num_val else None
    return demos.window_rows(*sizes, range(split)), held_out


def checksum(values: Tensor) -> float:
    """The exact sum, rounded once: the same on every machine and for any number of threads.

    >>> checksum(torch.tensor([1e16, 1.0, -1e16], dtype=torch.float64))
    1.0
    """
    return math.fsum(values.flatten().tolist())


def step_seed(seed: int, step: int) -> int:
    """Seed of torch's global generator in step ``step``; distinct for all steps of a training.

    torch's CPU generator reads only the low 32 bits of a seed, so both numbers have to be mixed into those.

    Examples:
        >>> step_seed(0, 5), step_seed(1, 5) == step_seed(0, 5)
        (5, False)
    """
    return (seed * 0x9E3779B1 + step) % 2**32


def batch_indices(num_windows: int, batch_size: int, step: int, seed: int) -> Tensor:
    """Windows of step ``step``, i64 [batch_size].

    Every epoch is a permutation of all windows that follows from (seed, epoch). Batches run on over the end
    of an epoch, so that every window is used equally often.

    Examples:
        >>> torch.cat([batch_indices(6, 3, step, seed=0) for step in range(2)]).sort().values.tolist()
        [0, 1, 2, 3, 4, 5]
    """
    position = torch.arange(step * batch_size, (step + 1) * batch_size)
    epoch, offset = position // num_windows, position % num_windows
    index = torch.empty_like(offset)
    for number in epoch.unique().tolist():
        generator = torch.Generator().manual_seed(step_seed(seed, number))
        chosen = epoch == number
        index[chosen] = torch.randperm(num_windows, generator=generator)[offset[chosen]]
    return index
