"""Base of training on demonstrations: configuration, windows, held-out episodes and averaged weights."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.errors import InputError
from torchrl_sparse.training.trainer import Trainer

__all__ = ["DemonstrationTrainer", "TrainConfig", "split_windows", "trained_parameters"]


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training; defaults as published for low-dimensional robomimic (arXiv:2303.04137, Table VII).

    Attributes:
        max_steps: optimiser steps; the cosine of the learning rate ends there.
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

    Raises:
        InputError: if a value is out of its range.
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
            raise InputError(
                f"max_steps, batch_size: expected at least 1, "
                f"got max_steps={self.max_steps}, batch_size={self.batch_size}"
            )
        for name in ("lr_warmup_steps", "weight_decay", "max_grad_norm"):
            if not (value := getattr(self, name)) >= 0:
                raise InputError(f"{name}: expected 0 or more, got {value}")
        if not self.lr > 0:
            raise InputError(f"lr: expected a positive number, got {self.lr}")
        if self.precision not in ("fp32", "bf16"):
            raise InputError(f'precision: expected "fp32" or "bf16", got {self.precision!r}')
        if not 0 <= self.val_ratio < 1:
            raise InputError(f"val_ratio: expected a share in [0, 1), got {self.val_ratio}")


class DemonstrationTrainer(Trainer):
    """Base of trainers on demonstration windows, with a running average of the weights.

    Args:
        module: the module to train, in place.
        config: how to train.
        groups: parameter groups of the optimiser.
        train_rows: i64 [W, H], rows of the training windows.
        val_rows: the same of the held-out ones, or None.
    """

    def __init__(
        self,
        module: nn.Module,
        config: TrainConfig,
        groups: list[dict[str, Any]],
        train_rows: Tensor,
        val_rows: Tensor | None,
    ) -> None:
        from diffusers.training_utils import EMAModel  # seconds, which only a training needs

        self.train_rows, self.val_rows = train_rows, val_rows
        self._ema = EMAModel(
            trained_parameters(module),
            decay=config.ema_max_decay,
            power=config.ema_power,
            update_after_step=0,
            use_ema_warmup=True,
            foreach=True,
        )
        super().__init__(
            module,
            torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.95), fused=True),
            config,
            num_samples=len(train_rows),
            total=config.max_steps,
            warmup_steps=config.lr_warmup_steps,
        )

    @abstractmethod
    def window_loss(self, rows: Tensor) -> Tensor:
        """Return the scalar loss of windows ``rows`` i64 [B, H]."""

    def batch_losses(self, index: Tensor) -> dict[str, Tensor]:
        return {"loss": self.window_loss(self.train_rows[index])}

    def train_step(self) -> dict[str, float]:
        losses = super().train_step()
        self._ema.step(trained_parameters(self.module))
        return losses

    @torch.no_grad()
    def validate(self, max_windows: int = 512) -> dict[str, float]:
        """Return the averaged weights' loss on held-out episodes with fixed noise; empty if none are held out."""
        if self.val_rows is None:
            return {}
        self.module.eval()
        with torch.random.fork_rng(devices=[]), self._averaged_weights():
            torch.manual_seed(self.config.seed)
            rows = self.val_rows[torch.randperm(len(self.val_rows))[:max_windows]]
            loss = self.window_loss(rows.repeat(math.ceil(max_windows / len(rows)), 1))
        return {"loss": loss.item()}

    def averaged(self) -> nn.Module:
        """Return a copy of the module with the averaged weights, in evaluation mode."""
        module = copy.deepcopy(self.module).eval()
        self._ema.copy_to(trained_parameters(module))
        return module

    def state(self) -> dict[str, Any]:
        return super().state() | {"ema": self._ema.state_dict()}

    def load_state(self, state: dict[str, Any]) -> None:
        super().load_state(state)
        self._ema.load_state_dict(state["ema"])
        self._ema.to(next(self.module.parameters()).device)

    @contextmanager
    def _averaged_weights(self) -> Iterator[None]:
        self._ema.store(trained_parameters(self.module))
        self._ema.copy_to(trained_parameters(self.module))
        try:
            yield
        finally:
            self._ema.restore(trained_parameters(self.module))


def trained_parameters(module: nn.Module) -> list[nn.Parameter]:
    """Return the parameters of a module that are not frozen."""
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def split_windows(
    demos: Demonstrations, sizes: tuple[int, int, int], val_ratio: float
) -> tuple[Tensor, Tensor | None]:
    """Return the training windows, and those of the last ``val_ratio`` of episodes, None for a ratio of 0.

    Args:
        demos: the demonstrations.
        sizes: horizon, observation steps and action steps of a window, see `Demonstrations.window_rows`.
        val_ratio: share of the episodes.

    Raises:
        InputError: if that leaves no episode to train on.
    """
    num_val = math.ceil(val_ratio * len(demos))
    if num_val >= len(demos):
        raise InputError(
            f"val_ratio: expected one that leaves episodes to train on, got {val_ratio} of {len(demos)}"
        )
    split = len(demos) - num_val
    held_out = demos.window_rows(*sizes, range(split, len(demos))) if num_val else None
    return demos.window_rows(*sizes, range(split)), held_out
