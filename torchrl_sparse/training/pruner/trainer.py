"""Training what learns where to prune: SAG's pruner (arXiv:2601.12894, Section 3.3) and L2C's gates.

The frozen policy answers a small reference set of observations under the predicted mask, and the loss is

    L = |a(M) - a*|_p + beta * |mean(M) - rho|

a(M) being the normalised actions of the whole chunk and a* those of the dense policy on the same noise (or of the
demonstration). The mean can count blocks, as in the paper, or weigh them by what they cost. Everything random in
update s follows from ``(seed, s)``, so that a training that was stopped goes on bit by bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from torchrl_sparse import keys
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, check_reuse, prune_rate
from torchrl_sparse.blocks.sag.planner import check_rates, rate_threshold
from torchrl_sparse.blocks.sag.relaxed import denoise_relaxed, gumbel_gate, step_errors, straight_through_gate
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.training_state import read_checkpoint
from torchrl_sparse.training.pruner.reference import ANSWER_BATCH
from torchrl_sparse.training.trainer import batch_indices, checksum, step_seed

__all__ = ["Gates", "PrunerConfig", "PrunerTrainer", "imitate", "sparsity_loss"]

Cost = Literal["blocks", "flops", "seconds"]
_IMITATION_BATCH = 4  # the coordinates' tokens, which no observation changes, cost the most


class Gates(Protocol):
    """What can be trained: a module whose logits are positive where pruning is preferred."""

    rate_input: bool

    def prune_logits(self, cond: Tensor, rate: Tensor | None = None) -> Tensor:
        """f32 [B, K, 3L] for encoded observations f32 [B, To, D] and, if it is an input, rates f32 [B, 1]."""
        ...


@dataclass(frozen=True)
class PrunerConfig:
    """How to train; defaults as published.

    Attributes:
        rate: target prune rate rho, in (0, 1), of what ``cost`` counts.
        rate_range: lowest and highest target; with it every sample of a batch gets a target of its own, uniform
            in that range, and the gates must take it as an input. They then keep it exactly, and the sparsity loss
            is 0; ``cost`` has to be ``"blocks"``.
        epochs: passes over the reference set.
        max_updates: optimiser steps, if they shall be fewer than the epochs make; with 0, gates stay as they are taught
            by :func:`imitate`.
        batch_size: observations in an update.
        lr: peak learning rate, reached after 5 % of the updates; a cosine leads down to zero.
        beta: weight of the sparsity loss.
        norm: of the fidelity loss, ``"l1"`` or ``"l2"``.
        estimator: ``"ste"`` (straight-through) or ``"gumbel"`` (straight-through Gumbel-softmax).
        temperature: of ``"gumbel"``.
        sparsity: ``"global"``, or ``"block"``: every block has to reach the rate by itself (the paper's ablation).
        cost: what the rate counts: ``"blocks"`` (published), or each weighed by the ``"flops"`` or the measured
            ``"seconds"`` of its type.
        reuse: what pruned blocks reuse, see :mod:`torchrl_sparse.blocks.mask`.
        gradient: ``"chain"`` differentiates the whole chain of denoising steps; ``"step"`` cuts it between them
            (:func:`~torchrl_sparse.blocks.sag.relaxed.step_errors` says what is lost).
        explore: share of the pruned blocks that an update evaluates to learn what they are worth; the smaller,
            the cheaper an update and the noisier its gradient.
        checkpointed: recompute denoising steps in the backward pass, for the memory of one step.
        max_grad_norm: gradient norm clip.
        seed: fixes everything random.

    Raises:
        ValueError: if a value is out of its range.
    """

    rate: float = 0.91
    rate_range: tuple[float, float] | None = None
    epochs: int = 30
    max_updates: int | None = None
    batch_size: int = 32
    lr: float = 1e-4
    beta: float = 1.0
    norm: Literal["l1", "l2"] = "l1"
    estimator: Literal["ste", "gumbel"] = "ste"
    temperature: float = 1.0
    sparsity: Literal["global", "block"] = "global"
    cost: Cost = "blocks"
    reuse: Reuse = "type"
    gradient: Literal["chain", "step"] = "chain"
    explore: float = 1.0
    checkpointed: bool = True
    max_grad_norm: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, allowed in (
            ("norm", ("l1", "l2")),
            ("estimator", ("ste", "gumbel")),
            ("sparsity", ("global", "block")),
            ("cost", get_args(Cost)),
            ("gradient", ("chain", "step")),
        ):
            if (value := getattr(self, name)) not in allowed:
                raise ValueError(f"{name}: expected one of {list(allowed)}, got {value!r}")
        check_reuse(self.reuse)
        check_rates(self.rate, self.rate_range)
        if self.rate_range is not None:  # YAML brings a list
            object.__setattr__(self, "rate_range", tuple(self.rate_range))
            if self.cost != "blocks":
                raise ValueError(f"cost: expected 'blocks' with a rate_range, got {self.cost!r}")
        for name in ("epochs", "batch_size", "lr", "temperature"):
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name}: expected a positive number, got {value}")


def imitate(
    gates: Gates,
    masks: Sequence[Tensor],
    reference: TensorDict,
    *,
    updates: int = 600,
    lr: float = 3e-3,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Teach untrained gates a mask, the same for all observations, for their training to begin from.

    Gates that read the rate can be taught several, each at its own prune rate; one alone says nothing about the others.

    From a random mask of a long chain a training first has to find back to any that works, and each update of
    a mask that prunes little costs most. The cross-entropy is taken against probabilities of 1/4 and 3/4,
    since logits far from zero would get next to no gradient through the straight-through estimator.

    Args:
        gates: what will be trained, in place.
        masks: bool [K, 3L] each, True = pruned.
        reference: see :mod:`torchrl_sparse.training.pruner.reference`; its observations are what the mask is learned on.
        updates: for each mask.
        lr, seed: of the imitation.
        on_progress: called with (updates made, all).

    Raises:
        ValueError: if there is no mask, one is not of the gates' shape, or gates that do not read the rate get several.
    """
    if not masks or (len(masks) > 1 and not gates.rate_input):
        expected = "at least one" if gates.rate_input else "one for gates that do not read the rate"
        raise ValueError(f"masks: expected {expected}, got {len(masks)}")
    torch.manual_seed(seed)
    optimizer = torch.optim.Adam(gates.parameters(), lr)
    total = updates * len(masks)
    for update in range(total):
        mask = masks[update % len(masks)]
        cond = reference[keys.COND][torch.randint(len(reference), (_IMITATION_BATCH,))]
        rate = torch.full((len(cond), 1), prune_rate(mask).item()) if gates.rate_input else None
        logits = gates.prune_logits(cond, rate)
        if (shape := logits.shape[1:]) != mask.shape:
            raise ValueError(f"mask: expected [K, 3L] = {[*shape]} as the gates have, got {[*mask.shape]}")
        target = (0.25 + 0.5 * mask.to(logits)).expand_as(logits)
        loss = binary_cross_entropy_with_logits(logits[:, 1:], target[:, 1:])  # step 0 is never pruned
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        on_progress(update + 1, total)


def sparsity_loss(gate: Tensor, rate: Tensor, weight: Tensor, *, per_block: bool = False) -> Tensor:
    """``mean |sum w M / sum w - rho|`` over the batch, a scalar (SAG's global sparsity loss for equal weights).

    Args:
        gate: f32 [B, K, 3L], 1 = pruned.
        rate: target rho, f32 [B, 1].
        weight: cost of each block, f32 [3L].
        per_block: hold every block to the rate by itself; weights then do not matter.

    >>> gate = torch.tensor([[[0.0, 0.0], [1.0, 0.0]]])
    >>> sparsity_loss(gate, torch.tensor([[0.5]]), torch.tensor([3.0, 1.0])).item()
    0.125
    """
    if per_block:
        return (gate.mean(dim=1) - rate).abs().mean()
    return (weighted_rate(gate, weight) - rate).abs().mean()


def weighted_rate(gate: Tensor, weight: Tensor) -> Tensor:
    """Share of the cost that is pruned, f32 [B, 1]; see :func:`sparsity_loss`."""
    return (gate.mean(dim=1) @ (weight / weight.sum()))[:, None]


class PrunerTrainer:
    """Trains gates through a frozen policy.

    Args:
        gates: :class:`~torchrl_sparse.blocks.sag.network.PrunerNetwork` or :class:`~torchrl_sparse.blocks.l2c.StaticGates`.
        policy: the policy, with the sampler that will be pruned; its weights get no gradient.
        reference: see :mod:`torchrl_sparse.training.pruner.reference`; the last tenth is held out.
        config: how to train.

    Attributes:
        step: updates made.
        total: updates to make.
        weight: cost of each block, f32 [3L], as ``config.cost`` counts it.

    Raises:
        ValueError: if reference set and configuration do not fit each other or the gates.
    """

    def __init__(
        self, gates: torch.nn.Module, policy: DiffusionPolicy, reference: TensorDict, config: PrunerConfig
    ) -> None:
        if gates.rate_input != (config.rate_range is not None):
            raise ValueError(
                f"rate_range: expected one if and only if the gates read the rate, "
                f"got {config.rate_range} and rate_input={gates.rate_input}"
            )
        highest = 1 - 1 / policy.num_inference_steps
        if (asked := max(config.rate_range or (config.rate,))) > highest:
            raise ValueError(f"rate: expected at most {highest:g}, since the first step is kept, got {asked}")
        if len(reference) < 2:
            raise ValueError(f"reference set: expected at least 2 observations, got {len(reference)}")
        self.gates, self.policy, self.config = gates, policy, config
        self.policy.network.requires_grad_(False)
        held_out = max(1, len(reference) // 10)
        self.train_set, self.held_out = reference[:-held_out], reference[-held_out:]
        self.weight = _block_weights(policy, config.cost)
        updates = math.ceil(config.epochs * len(self.train_set) / config.batch_size)
        self.total = updates if config.max_updates is None else min(updates, config.max_updates)
        self._optimizer = torch.optim.AdamW(gates.parameters(), lr=config.lr, weight_decay=0.0)
        self._schedule = get_cosine_schedule_with_warmup(self._optimizer, self.total // 20, self.total)
        self.step = 0

    def train_step(self) -> dict[str, float]:
        """One update; returns its losses and prune rates.

        Raises:
            FloatingPointError: if the loss is not finite; the weights are then those of the update before.
        """
        config = self.config
        torch.manual_seed(step_seed(config.seed, self.step))
        index = batch_indices(len(self.train_set), config.batch_size, self.step, config.seed)
        batch = self.train_set[index]
        self.gates.train()
        rate = self._draw_rates(len(batch))
        gate = self._gate(batch[keys.COND], rate)
        fidelity = self._fidelity(batch, gate)
        sparsity = sparsity_loss(gate, rate, self.weight, per_block=config.sparsity == "block")
        loss = fidelity + config.beta * sparsity
        if not math.isfinite(loss.item()):
            raise FloatingPointError(f"update {self.step}: loss is {loss.item()}")
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.gates.parameters(), config.max_grad_norm)
        self._optimizer.step()
        self._schedule.step()
        self.step += 1
        return {
            "fidelity": fidelity.item(),
            "sparsity": sparsity.item(),
            **_rates(gate.detach(), self.weight),
        }

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Error of the actions and prune rates on held-out observations, with the masks as they will be used, and
        the variance of the masks over observations."""
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
        return {"error": error.item(), "variance": variance.item(), **_rates(gate, self.weight)}

    @torch.no_grad()
    def fixed_mask(self) -> Tensor:
        """The mean of the masks of all training observations, bool [K, 3L]: what the gates prune most often, as many
        cells as they prune on average. L2C's result, and of SAG the ablation that does not look."""
        parts = self.train_set[keys.COND].split(ANSWER_BATCH)
        share = sum(self._masks(part).sum(dim=0) for part in parts) / len(self.train_set)
        mask = torch.zeros(share.numel(), dtype=torch.bool)
        mask[share.flatten().argsort(descending=True, stable=True)[: round(share.sum().item())]] = True
        return mask.view_as(share)

    def save(self, path: str | Path) -> None:
        """Write a checkpoint. A kill leaves the old file or the new one, never a part of one."""
        state = {
            **self._header(),
            "step": self.step,
            "weight": self.weight,
            "gates": self.gates.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(),
        }
        with atomic_path(path) as temporary:
            torch.save(state, temporary)

    def load(self, path: str | Path) -> None:
        """Continue from a checkpoint. Nothing in the file is executed.

        Raises:
            ValueError: if it is none, or was made for another policy, reference set or configuration.
        """
        header = self._header()
        state = read_checkpoint(path, {*header, "step", "weight", "gates", "optimizer", "schedule"}, header)
        self.weight = state["weight"]  # seconds are measured anew in every process
        self.gates.load_state_dict(state["gates"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.step = state["step"]

    def _masks(self, cond: Tensor) -> Tensor:
        """The masks bool [B, K, 3L] as they will be used, at the rate that is trained for."""
        self.gates.eval()
        masks = self._logits(cond, torch.full((len(cond), 1), self.config.rate)) > 0
        masks[:, 0] = False
        return masks

    def _logits(self, cond: Tensor, rate: Tensor) -> Tensor:
        if not self.gates.rate_input:
            return self.gates.prune_logits(cond)
        logits = self.gates.prune_logits(cond, rate)
        return logits - rate_threshold(logits, rate)

    def _gate(self, cond: Tensor, rate: Tensor) -> Tensor:
        logits = self._logits(cond, rate)
        if self.config.estimator == "gumbel":
            return gumbel_gate(logits, self.config.temperature)
        return straight_through_gate(logits)

    def _draw_rates(self, batch: int) -> Tensor:
        if self.config.rate_range is None:
            return torch.full((batch, 1), self.config.rate)
        low, high = self.config.rate_range
        return low + (high - low) * torch.rand(batch, 1)

    def _fidelity(self, batch: TensorDict, gate: Tensor) -> Tensor:
        config, policy = self.config, self.policy
        query = (
            policy.network,
            policy.sampler,
            policy.sample_noise(batch[keys.SEED].squeeze(-1)),
            batch[keys.COND],
        )
        options = {
            "reuse": config.reuse,
            "explore": config.explore,
            "checkpointed": config.checkpointed,
        }
        if config.gradient == "step":
            error = step_errors(*query, gate, **options)
        else:
            actions = denoise_relaxed(*query, gate, **options)
            error = (actions - batch["target"]).abs()
        return error.mean() if config.norm == "l1" else error.square().mean()

    def _header(self) -> dict[str, Any]:
        """What a checkpoint must have been made with to be gone on from."""
        return {
            "config": asdict(self.config),
            "policy": {"fingerprint": self.policy.fingerprint, **self.policy.sampler.config},
            "reference": {
                "size": len(self.train_set) + len(self.held_out),
                "checksum": checksum(self.train_set["target"]) + checksum(self.train_set[keys.COND]),
            },
        }


def _block_weights(policy: DiffusionPolicy, cost: Cost) -> Tensor:
    """Cost of each block, f32 [3L]."""
    if cost == "blocks":
        return torch.ones(policy.num_blocks)
    costs = policy.block_costs()
    return (
        torch.tensor([getattr(costs[kind], cost) for kind in BLOCK_TYPES])
        .float()
        .repeat(policy.network.n_layer)
    )


def _rates(gate: Tensor, weight: Tensor) -> dict[str, float]:
    """Prune rates: of all blocks, of the cost, and of each type of block."""
    by_type = gate.mean(dim=(0, 1)).view(-1, len(BLOCK_TYPES)).mean(dim=0)
    shares = {f"rate_{kind}": value for kind, value in zip(BLOCK_TYPES, by_type.tolist(), strict=True)}
    return {"rate": gate.mean().item(), "rate_cost": weighted_rate(gate, weight).mean().item(), **shares}
