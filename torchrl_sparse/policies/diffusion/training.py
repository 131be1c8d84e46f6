"""Training a diffusion policy on demonstrations, see `torchrl_sparse.policies.trainer`."""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor

from torchrl_sparse.data.normalize import Normalizer
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.diffusion.loss import DiffusionLoss
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion, optimizer_groups
from torchrl_sparse.policies.trainer import TrainConfig, Trainer, split_windows

__all__ = ["PolicyTrainer"]


class PolicyTrainer(Trainer):
    """Trains a denoiser on demonstrations.

    Args:
        network: the network, trained in place.
        normalizer: of states and actions.
        demos: demonstrations.
        config: how to train.

    Attributes:
        step: optimiser steps taken.
        lr: the learning rate of the next step.

    Raises:
        ValueError: if ``val_ratio`` leaves no episode to train on.
    """

    def __init__(
        self,
        network: TransformerForDiffusion,
        normalizer: Normalizer,
        demos: Demonstrations,
        config: TrainConfig,
    ) -> None:
        self.normalizer, self.demos = normalizer, demos
        self.loss = DiffusionLoss(network, normalizer, NoiseSchedule())
        sizes = (network.horizon, network.n_obs_steps, config.n_action_steps)
        groups = optimizer_groups(network, config.weight_decay)
        super().__init__(network, config, groups, *split_windows(demos, sizes, config.val_ratio))

    def batch_loss(self, rows: Tensor) -> Tensor:
        batch = self.demos.windows(rows, self.network.n_obs_steps)
        device = next(self.network.parameters()).device
        with torch.autocast(device.type, torch.bfloat16, enabled=self.config.precision == "bf16"):
            return self.loss(batch.to(device)).get("loss")

    def header(self) -> dict[str, dict]:
        data = self.demos.data
        return {
            "config": asdict(self.config),
            "network_config": dict(self.network.config),
            "data": {
                "windows": len(self.train_rows),
                "checksum": sum(float(v.double().sum()) for v in data.values(True, True)),
            },
        }
