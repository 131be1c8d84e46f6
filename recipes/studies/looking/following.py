"""Measurement of how much a pruner's masks differ between observations, when they differ, and whether that pays.

A pruner that reads the observation (SAG, arXiv:2601.12894) can end up with one mask for all observations and lose nothing by
its own loss. So its masks are compared with their own mean, which prunes as much and reads nothing, and with each other's: if
the masks of other observations do as well as a policy call's own, what differs between them does not come from seeing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.planner import Dense
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import ANSWER_BATCH, dense_answers
from torchrl_sparse.training.pruner.loss import varying_share
from torchrl_sparse.training.pruner.trainer import mean_mask

__all__ = [
    "Looking",
    "actions_under",
    "episode_phases",
    "episode_rows",
    "looking",
    "paired_interval",
    "planned_queries",
]


@dataclass(frozen=True)
class Looking:
    """Statistics of a pruner's masks over rollouts.

    Attributes:
        policy calls, episodes: that were looked at.
        rate: mean prune rate.
        varying: share of the cells, of all K x 3L, that differ between any two calls.
        varying_in_episode: the same within an episode, mean over episodes with two calls or more.
        differing: share of the cells in which a call's mask differs from the mean mask, mean over calls.
        error: mean absolute difference to the dense policy's actions on the same noise, normalised, over the executed
            actions: under the call's ``"own"`` mask, the ``"mean"`` mask, and ``"others"``, the mask of another call.
        own_minus_mean, own_minus_others: differences of those errors with the 95 % interval of their mean over episodes;
            below 0, looking pays.
        phases: ``[P][K][3L]``, share of an episode phase's calls that prune each cell, minus that of all calls.
    """

    queries: int
    episodes: int
    rate: float
    varying: float
    varying_in_episode: float
    differing: float
    error: dict[str, float]
    own_minus_mean: tuple[float, float, float]
    own_minus_others: tuple[float, float, float]
    phases: list[list[list[float]]]


@torch.no_grad()
def looking(
    policy: DiffusionPolicy,
    queries: TensorDictBase,
    *,
    n_action_steps: int = 8,
    phases: int = 4,
    seed: int = 0,
) -> Looking:
    """Compute the masks of recorded policy calls, and their actions under these masks and others.

    Args:
        policy: with the pruner as its planner.
        queries: [N], of `torchrl_sparse.control.queries.record_queries`; none that the pruner was trained on.
        n_action_steps: actions of a chunk that are executed.
        phases: equal parts of an episode's calls.
        seed: of whose mask a call gets as another's.

    Raises:
        InputError: if there are fewer than two episodes.
    """
    policy = policy.with_plan(policy.plan)
    encoded = planned_queries(policy, queries)
    masks, starts = encoded[keys.PRUNE_MASK], episode_rows(encoded)
    mean = mean_mask(masks.float().mean(dim=0))
    other = torch.randperm(len(masks), generator=torch.Generator().manual_seed(seed)).roll(1)
    dense = dense_answers(policy.with_plan(Dense()), encoded)
    candidates = {"own": masks, "mean": mean.expand_as(masks).contiguous(), "others": masks[other]}
    first = policy.n_obs_steps - 1
    errors = {
        name: (actions_under(policy, encoded, asked) - dense)[:, first : first + n_action_steps]
        .abs()
        .mean(dim=(1, 2))
        for name, asked in candidates.items()
    }
    repeated = [rows for rows in starts if len(rows) > 1]
    return Looking(
        queries=len(masks),
        episodes=len(starts),
        rate=masks.float().mean().item(),
        varying=varying_share(masks).item(),
        varying_in_episode=float(np.mean([varying_share(masks[rows]).item() for rows in repeated])),
        differing=(masks != mean).float().mean().item(),
        error={name: error.mean().item() for name, error in errors.items()},
        own_minus_mean=paired_interval(errors["own"] - errors["mean"], starts),
        own_minus_others=paired_interval(errors["own"] - errors["others"], starts),
        phases=_phases(masks, starts, phases).tolist(),
    )


def planned_queries(policy: DiffusionPolicy, queries: TensorDictBase) -> TensorDictBase:
    """Return policy calls with their conditions and the masks that the policy's planner writes for them."""
    return policy.module["plan"](policy.module["encode"](queries.select(*policy.in_keys, strict=False)))


def actions_under(policy: DiffusionPolicy, encoded: TensorDictBase, masks: Tensor) -> Tensor:
    """Return normalised actions [N, H, A] of policy calls under ``masks`` and the planner's reuse rule."""
    noise = policy.sample_noise(encoded[keys.SEED].flatten())
    parts = zip(*(part.split(ANSWER_BATCH) for part in (noise, encoded[keys.COND], masks)), strict=True)
    return torch.cat([policy.denoise(*part, reuse=policy.plan.reuse) for part in parts])


def episode_rows(queries: TensorDictBase) -> list[Tensor]:
    """Return the rows of each episode, in order.

    Raises:
        InputError: if there are fewer than two.
    """
    episodes = queries[keys.EPISODE_SEED].flatten()
    rows = [(episodes == number).nonzero().flatten() for number in episodes.unique()]
    if len(rows) < 2:
        raise InputError(f"queries: expected those of two episodes at least, got {len(rows)}")
    return rows


def episode_phases(episodes: list[Tensor], count: int, phases: int) -> Tensor:
    """Return, i64 [count], the phase of each policy call: which of the equal parts of its episode it is in."""
    phase = torch.empty(count, dtype=torch.long)
    for rows in episodes:
        phase[rows.cpu()] = torch.arange(len(rows)) * phases // len(rows)
    return phase


def paired_interval(difference: Tensor, episodes: list[Tensor]) -> tuple[float, float, float]:
    """Return the mean over episodes and its 95 % interval; policy calls of one episode are not independent samples."""
    by_episode = torch.stack([difference[rows].mean() for rows in episodes])
    mean, half = by_episode.mean().item(), 1.96 * by_episode.std().item() / len(episodes) ** 0.5
    return mean, mean - half, mean + half


def _phases(masks: Tensor, episodes: list[Tensor], phases: int) -> Tensor:
    """Return f32 [P, K, 3L]: how much more often than on average each cell is pruned in each phase, 0 without a policy call."""
    masks, phase = masks.cpu(), episode_phases(episodes, len(masks), phases)
    change = torch.zeros(phases, *masks.shape[1:])
    for number in phase.unique().tolist():
        change[number] = masks[phase == number].float().mean(dim=0) - masks.float().mean(dim=0)
    return change
