"""Training of pruning gates: SAG's pruner (arXiv:2601.12894, Section 3.3) and L2C's static gates.

The frozen policy answers observations of a small calibration set under the predicted mask, and the loss is

    L = |a(M) - a*|_p + beta * |mean(M) - rho|

a(M) being the normalised actions of the whole chain and a* the targets: those of the dense policy on the same noise, or of the
demonstration. The mean can count blocks, as in the paper, or weigh them by what they cost. The first term can also be
Learning-to-Cache's own (arXiv:2406.01733), of the noise predicted in one step (`PrunerConfig.objective`). A reward for masks
that follow the observation can be added (`PrunerConfig.variety`).
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.l2c import noise_errors
from torchrl_sparse.blocks.sag.planner import rate_threshold
from torchrl_sparse.blocks.sag.relaxed import denoise_relaxed, gumbel_gate, step_errors, straight_through_gate
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import ANSWER_BATCH
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.gates import Gates
from torchrl_sparse.training.pruner.loss import (
    block_weights,
    mutual_information,
    rate_metrics,
    sparsity_loss,
    variety_reward,
    varying_share,
)
from torchrl_sparse.training.trainer import Trainer, checksum

__all__ = ["PrunerTrainer", "mean_mask"]


class PrunerTrainer(Trainer):
    """Trainer of gates through a frozen policy.

    Args:
        gates: :class:`~torchrl_sparse.blocks.sag.network.PrunerNetwork` or :class:`~torchrl_sparse.blocks.l2c.StaticGates`.
        policy: the policy, with the sampler that will be pruned; its weights get no gradient.
        targets: of the calibration set, see `make_targets`, where gates and policy are; the last tenth is held out.
        config: how to train.

    Attributes:
        weight: cost of each block, f32 [3L], as ``config.cost`` counts it.

    Raises:
        InputError: if calibration set, configuration and gates do not fit each other.
    """

    def __init__(
        self, gates: Gates, policy: DiffusionPolicy, targets: TensorDict, config: PrunerConfig
    ) -> None:
        if gates.rate_input != (config.rate_range is not None):
            raise InputError(
                f"rate_range: expected one if and only if the gates read the rate, "
                f"got {config.rate_range} and rate_input={gates.rate_input}"
            )
        steps = torch.arange(policy.num_inference_steps)
        may_prune = (steps % 2 == 1 if config.objective == "noise" else steps > 0)[:, None]
        self._may_prune = may_prune.to(policy.device)
        highest = self._may_prune.double().mean().item()
        if (asked := max(config.rate_range or (config.rate,))) > highest:
            kept = "every other step" if config.objective == "noise" else "the first step"
            raise InputError(f"rate: expected at most {highest:g}, since {kept} is kept, got {asked}")
        if len(targets) < 2:
            raise InputError(f"targets: expected at least 2 observations, got {len(targets)}")
        self.gates, self.policy = gates, policy
        policy.network.requires_grad_(False)
        held_out = max(1, len(targets) // 10)
        self.train_set, self.held_out = targets[:-held_out], targets[-held_out:]
        self.weight = block_weights(policy, config.cost).to(policy.device)
        total = math.ceil(config.epochs * len(self.train_set) / config.batch_size)
        if config.max_updates is not None:
            total = min(total, config.max_updates)
        super().__init__(
            gates,
            torch.optim.AdamW(gates.parameters(), lr=config.lr, weight_decay=0.0),
            config,
            num_samples=len(self.train_set),
            total=total,
            warmup_steps=total // 20,
        )

    def batch_losses(self, index: Tensor) -> dict[str, Tensor]:
        """Return the loss, its parts ``"fidelity"`` and ``"sparsity"``, and the prune rates for samples ``index``, i64 [B]."""
        batch = self.train_set[index]
        rate = self._draw_rates(len(batch))
        logits = self._logits(batch[keys.COND], rate)
        gate = self._gate(logits)
        return self._losses(self._fidelity(batch, gate), logits, gate, rate)

    def _losses(self, fidelity: Tensor, logits: Tensor, gate: Tensor, rate: Tensor) -> dict[str, Tensor]:
        config = self.config
        sparsity = sparsity_loss(gate, rate, self.weight, per_block=config.sparsity == "block")
        information = mutual_information(logits)
        loss = fidelity + config.beta * sparsity
        if config.variety:
            loss = loss - config.variety * variety_reward(information, config.information)
        return {
            "loss": loss,
            "fidelity": fidelity,
            "sparsity": sparsity,
            "information": information.detach(),
            **rate_metrics(gate.detach(), self.weight, self.policy.network.block_types),
        }

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the action error and prune rates on held-out observations, with the final hard masks. Also return how much
        masks vary over observations: their variance, and the share of cells that ever differ.
        """
        cond = self.held_out[keys.COND]
        masks = self._masks(cond)
        noise = self.policy.sample_noise(self.held_out[keys.SEED].squeeze(-1))
        actions = [
            self.policy.denoise(*part, reuse=self.config.reuse)
            for part in zip(
                noise.split(ANSWER_BATCH), cond.split(ANSWER_BATCH), masks.split(ANSWER_BATCH), strict=True
            )
        ]
        error = (torch.cat(actions) - self.held_out["target"]).abs().mean()
        gate = masks.float()
        variance = gate.var(dim=0, unbiased=False).mean()
        metrics = {
            "error": error,
            "variance": variance,
            "varying": varying_share(masks),
            **rate_metrics(gate, self.weight, self.policy.network.block_types),
        }
        return {name: value.item() for name, value in metrics.items()}

    @torch.no_grad()
    def fixed_mask(self) -> Tensor:
        """Return the mean mask of all training observations, bool [K, 3L]: the cells pruned most often, as many as are pruned
        on average. This is L2C's result, and SAG's ablation that does not read the observation.
        """
        cond = self.train_set[keys.COND]
        masks = (self._masks(part) for part in cond.split(ANSWER_BATCH))
        return mean_mask(sum(mask.sum(dim=0) for mask in masks) / len(cond))

    def header(self) -> dict[str, dict[str, Any]]:
        size = len(self.train_set) + len(self.held_out)
        return {
            "config": asdict(self.config),
            "policy": {"fingerprint": self.policy.fingerprint, **self.policy.sampler.config},
            "targets": {
                "size": size,
                "checksum": checksum(self.train_set["target"]) + checksum(self.train_set[keys.COND]),
            },
        }

    def state(self) -> dict[str, Any]:
        return super().state() | {"weight": self.weight}

    def load_state(self, state: dict[str, Any]) -> None:
        super().load_state(state)
        self.weight = state["weight"].to(self.policy.device)  # seconds are measured again in every process

    def _masks(self, cond: Tensor) -> Tensor:
        """Return the masks bool [B, K, 3L] as they will be used, at the rate that is trained for."""
        self.gates.eval()
        masks = self._logits(cond, torch.full((len(cond), 1), self.config.rate, device=cond.device)) > 0
        return masks & self._may_prune

    def _logits(self, cond: Tensor, rate: Tensor) -> Tensor:
        if not self.gates.rate_input:
            return self.gates.prune_logits(cond)
        logits = self.gates.prune_logits(cond, rate)
        return logits - rate_threshold(logits, rate)

    def _gate(self, logits: Tensor) -> Tensor:
        if self.config.estimator == "gumbel":
            gate = gumbel_gate(logits, self.config.temperature_at(self.step / self.total))
        else:
            gate = straight_through_gate(logits)
        return gate * self._may_prune

    def _draw_rates(self, batch: int) -> Tensor:
        if self.config.rate_range is None:
            return torch.full((batch, 1), self.config.rate, device=self.policy.device)
        low, high = self.config.rate_range
        return low + (high - low) * torch.rand(batch, 1).to(self.policy.device)

    def _fidelity(self, batch: TensorDict, gate: Tensor) -> Tensor:
        if self.config.objective == "noise":
            error = self._noise_errors(batch, gate)
        elif self.config.gradient == "step":
            error = step_errors(*self._query(batch, gate), **self._relaxed_options())
        else:
            error = denoise_relaxed(*self._query(batch, gate), **self._relaxed_options()) - batch["target"]
        return self._norm(error)

    def _query(self, batch: TensorDict, gate: Tensor) -> tuple:
        """Return what a policy call of the policy is made of: network, sampler, noise, condition and gates or mask."""
        noise = self.policy.sample_noise(batch[keys.SEED].squeeze(-1))
        return self.policy.network, self.policy.sampler, noise, batch[keys.COND], gate

    def _relaxed_options(self) -> dict[str, Any]:
        return {name: getattr(self.config, name) for name in ("reuse", "explore", "checkpointed", "detached")}

    def _norm(self, error: Tensor) -> Tensor:
        return error.abs().mean() if self.config.norm == "l1" else error.square().mean()

    def _noise_errors(self, batch: TensorDict, gate: Tensor) -> Tensor:
        """Return the errors of one step for the whole batch, drawn with its noise, as L2C's release does."""
        clean, policy = batch["target"], self.policy
        step = 1 + 2 * int(torch.randint(policy.num_inference_steps // 2, ()))
        noise = torch.randn(len(clean), 2, *clean.shape[1:]).to(clean.device)
        return noise_errors(
            policy.network, policy.sampler, clean, noise, batch[keys.COND], gate[:, step], step
        )


def mean_mask(share: Tensor) -> Tensor:
    """Return the mask nearest to many masks, bool [K, 3L]: the cells pruned most often, as many as are pruned on average.

    Args:
        share: of the masks that prune each cell, f32 [K, 3L].

    >>> mean_mask(torch.tensor([[0.0, 0.0], [0.9, 0.4]])).tolist()
    [[False, False], [True, False]]
    """
    mask = torch.zeros(share.numel(), dtype=torch.bool, device=share.device)
    mask[share.flatten().argsort(descending=True, stable=True)[: round(share.sum().item())]] = True
    return mask.view_as(share)
