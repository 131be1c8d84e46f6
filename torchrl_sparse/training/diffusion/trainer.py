"""Training of a diffusion policy on demonstrations, see `torchrl_sparse.training.demonstrations`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.envs.contract import check_contract
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.demonstrations import DemonstrationTrainer, TrainConfig, split_windows
from torchrl_sparse.training.diffusion.loss import DiffusionLoss
from torchrl_sparse.training.diffusion.optimizer import optimizer_groups
from torchrl_sparse.training.trainer import checksum

__all__ = ["PolicyTrainer"]

_VISION_WEIGHT_DECAY = 1e-6  # of all weights of the cameras' encoder, as published


class PolicyTrainer(DemonstrationTrainer):
    """Trainer of a diffusion policy's networks on demonstrations.

    Args:
        policy: the policy, whose networks are trained in place. Normaliser, sampler and ``source`` stay as they are.
        demos: demonstrations of what it observes.
        config: how to train.

    Raises:
        InputError: if ``val_ratio`` leaves no episode to train on, or the demonstrations mean something else than what the
            policy observes.
    """

    def __init__(self, policy: DiffusionPolicy, demos: Demonstrations, config: TrainConfig) -> None:
        check_contract(policy, demos.contract)
        self.policy, self.demos = policy, demos
        self.network, self.vision = network, vision = policy.network, policy.vision
        self.loss = DiffusionLoss(network, policy.normalizer, policy.sampler, vision)
        self._data_checksum = sum(checksum(value) for value in demos.data.values(True, True))
        sizes = (network.horizon, network.n_obs_steps, config.n_action_steps)
        groups, module = optimizer_groups(network, config.weight_decay), network
        if vision is not None:
            groups.append({"params": [*vision.parameters()], "weight_decay": _VISION_WEIGHT_DECAY})
            module = nn.ModuleDict({"network": network, "vision": vision})
        super().__init__(module, config, groups, *split_windows(demos, sizes, config.val_ratio))

    def ema_policy(self, sampler: Sampler | None = None) -> DiffusionPolicy:
        """Return a policy with copies of the networks that hold the averaged weights.

        Args:
            sampler: of as many training steps as the policy's; None for the policy's own.
        """
        averaged = self.averaged()
        network, vision = (
            (averaged, None) if self.vision is None else (averaged["network"], averaged["vision"])
        )
        policy = DiffusionPolicy(network, self.policy.normalizer, vision=vision, sampler=self.policy.sampler)
        policy.source = self.policy.source
        if sampler is not None:
            policy.sampler = sampler
        return policy

    def window_loss(self, rows: Tensor) -> Tensor:
        batch = self.demos.windows(rows, self.network.n_obs_steps)
        device = next(self.network.parameters()).device
        precision = torch.autocast(device.type, torch.bfloat16, enabled=self.config.precision == "bf16")
        with precision, _attention(device):
            return self.loss(batch.to(device)).get("loss")

    def header(self) -> dict[str, dict]:
        header = {
            "config": asdict(self.config),
            "network_config": dict(self.network.config),
            "data": {"windows": len(self.train_rows), "checksum": self._data_checksum},
        }
        return header if self.vision is None else header | {"vision_config": dict(self.vision.config)}


def _attention(device: torch.device) -> AbstractContextManager:
    """On a CPU the plain kernel: PyTorch's choice without dropout, the fused one, is slow on chunks as short as these."""
    return sdpa_kernel(SDPBackend.MATH) if device.type == "cpu" else nullcontext()
