"""A search for how much observation-conditioned masks could gain: masks shared by all calls, by a phase, or by none.

Masks are climbed to, from one that all share, with the answers of the dense policy known, which no pruner knows, on some draws
of noise; and they are judged on others. What masks of their own gain there is what a pruner that reads the observation could
learn. It is no upper bound: a call's own mask is found with few draws of noise, and a part of what it fits is those.

Each attempt swaps a few cells that are computed for as many pruned ones of the same type, so every mask costs what the first
one does. It is kept where the mean error of the calls that share the mask falls. All are given as many attempts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from recipes.studies.looking.following import (
    actions_under,
    episode_phases,
    episode_rows,
    paired_interval,
    planned_queries,
)
from torchrl_sparse import keys
from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import dense_answers
from torchrl_sparse.training.pruner.trainer import mean_mask

__all__ = ["Climber", "Oracle", "oracle", "swap_cells"]


@dataclass(frozen=True)
class Oracle:
    """Errors of searched masks that are shared by fewer and fewer policy calls.

    Attributes:
        calls, episodes: that masks were climbed to for.
        attempts: for each mask.
        draws: of noise for each call while climbing, and as many others in the judgement.
        seen, error: mean absolute difference to the dense policy's actions on the same noise, normalised, on the draws that
            were climbed on and on the others: of ``"start"``, the mask that all began with, and of masks shared by
            ``"all"`` calls, by those of a ``"phase"`` and by none, ``"query"``.
        over_all: of each, the error minus that of the mask of ``"all"``, with the 95 % interval of its mean over episodes.
    """

    queries: int
    episodes: int
    attempts: int
    draws: int
    seen: dict[str, float]
    error: dict[str, float]
    over_all: dict[str, tuple[float, float, float]]


class Climber:
    """Hill climber over masks, scored on fixed draws of noise.

    Args:
        policy: with the sampler that is pruned, and the planner whose rule of reuse holds.
        queries: [N], with ``("diffusion", "cond")``.
        draws: of noise for each policy call.
        n_action_steps: actions of a chunk that are executed.
        seed: of the noise.
    """

    def __init__(
        self,
        policy: DiffusionPolicy,
        queries: TensorDictBase,
        *,
        draws: int,
        n_action_steps: int,
        seed: int,
    ) -> None:
        self._policy, self._draws = policy, draws
        generator = torch.Generator().manual_seed(seed)
        seeds = torch.randint(2**62, (len(queries) * draws, 1), generator=generator).to(policy.device)
        cond = queries[keys.COND].repeat_interleave(draws, dim=0)
        self._asked = TensorDict({keys.COND: cond, keys.SEED: seeds}, [len(seeds)])
        first = policy.n_obs_steps - 1
        self._executed = slice(first, first + n_action_steps)
        self._dense = dense_answers(policy.with_plan(None, policy.sampler), self._asked)[:, self._executed]

    @torch.no_grad()
    def errors(self, masks: Tensor) -> Tensor:
        """Return the error of each policy call under its mask, f32 [N] on the CPU, for ``masks`` bool [N, K, 3L]."""
        repeated = masks.to(self._policy.device).repeat_interleave(self._draws, dim=0)
        answers = actions_under(self._policy, self._asked, repeated)[:, self._executed]
        error = (answers - self._dense).abs().mean(dim=(1, 2))
        return error.unflatten(0, (-1, self._draws)).mean(dim=1).cpu()

    def climb(
        self,
        start: Tensor,
        groups: Tensor,
        attempts: int,
        *,
        seed: int = 0,
        on_attempt: Callable[[], object] = lambda: None,
    ) -> Tensor:
        """Return the masks that hill climbing found, bool [N, K, 3L], equal within a group.

        Args:
            start: bool [K, 3L], where all begin.
            groups: i64 [N], the number of each policy call's group, 0 to G - 1.
            attempts: swaps that are tried for each group.
            seed: of the swaps.
            on_attempt: called after each.
        """
        rng = np.random.default_rng(seed)
        masks = start.expand(int(groups.max()) + 1, *start.shape).clone()
        best = self._by_group(masks, groups)
        for _ in range(attempts):
            tried = torch.stack([swap_cells(mask, rng) for mask in masks])
            found = self._by_group(tried, groups)
            better = found < best
            masks, best = torch.where(better[:, None, None], tried, masks), torch.minimum(found, best)
            on_attempt()
        return masks[groups]

    def _by_group(self, masks: Tensor, groups: Tensor) -> Tensor:
        errors = self.errors(masks[groups]).double()
        return torch.zeros(len(masks), dtype=torch.double).index_add(0, groups, errors) / groups.bincount()


def swap_cells(mask: Tensor, rng: np.random.Generator) -> Tensor:
    """Return a mask with as many computed blocks of each type, usually with one cell swapped for another.

    Args:
        mask: bool [K, 3L], True = pruned; the first step stays as it is.
        rng: chooses type, number and cells.

    >>> mask = torch.tensor([[False] * 3, [False, True, True], [True] * 3])
    >>> swap_cells(mask, np.random.default_rng(0)).int().tolist()
    [[0, 0, 0], [1, 1, 1], [0, 1, 1]]
    """
    kinds = [kind for kind in range(len(BLOCK_TYPES)) if _swappable(mask, kind)]
    if not kinds:
        return mask.clone()
    kind = rng.choice(kinds)
    cells = mask[1:, kind :: len(BLOCK_TYPES)].clone()
    computed, pruned = (~cells).flatten().nonzero().flatten(), cells.flatten().nonzero().flatten()
    number = min(int(rng.geometric(0.6)), len(computed), len(pruned))
    for some in (computed, pruned):
        cells.view(-1)[some[rng.choice(len(some), number, replace=False)]] ^= True
    swapped = mask.clone()
    swapped[1:, kind :: len(BLOCK_TYPES)] = cells
    return swapped


def _swappable(mask: Tensor, kind: int) -> bool:
    cells = mask[1:, kind :: len(BLOCK_TYPES)]
    return bool(cells.any() and not cells.all())


def oracle(
    policy: DiffusionPolicy,
    queries: TensorDictBase,
    *,
    attempts: int,
    draws: int = 8,
    phases: int = 4,
    n_action_steps: int = 8,
    seed: int = 0,
    on_attempt: Callable[[], object] = lambda: None,
) -> Oracle:
    """Search masks for all policy calls, for each episode phase and for each call, and score them on fresh noise.

    Args:
        policy: with the pruner as its planner; all begin at the mean of its masks.
        queries: [N], of `torchrl_sparse.control.queries.record_queries`.
        attempts: for each mask.
        draws: of noise for each call, while climbing and in the judgement.
        phases: equal parts of an episode's calls.
        n_action_steps: actions of a chunk that are executed.
        seed: of noise and swaps.
        on_attempt: called after each, ``3 * attempts`` times.

    Raises:
        InputError: if there are fewer than two episodes.
    """
    policy = policy.with_plan(policy.plan)
    encoded = planned_queries(policy, queries)
    start = mean_mask(encoded[keys.PRUNE_MASK].float().mean(dim=0)).cpu()
    episodes = episode_rows(encoded)
    shared = {
        "all": torch.zeros(len(queries), dtype=torch.long),
        "phase": episode_phases(episodes, len(queries), phases).unique(return_inverse=True)[1],
        "query": torch.arange(len(queries)),
    }
    options = {"draws": draws, "n_action_steps": n_action_steps}
    climber, judge = (Climber(policy, encoded, **options, seed=2 * seed + part) for part in range(2))
    masks = {"start": start.expand(len(queries), *start.shape)}
    for name, groups in shared.items():
        masks[name] = climber.climb(start, groups, attempts, seed=seed, on_attempt=on_attempt)
    seen, errors = ({name: by.errors(some) for name, some in masks.items()} for by in (climber, judge))
    return Oracle(
        queries=len(queries),
        episodes=len(episodes),
        attempts=attempts,
        draws=draws,
        seen={name: error.mean().item() for name, error in seen.items()},
        error={name: error.mean().item() for name, error in errors.items()},
        over_all={
            name: paired_interval(errors[name] - errors["all"], episodes)
            for name in ("start", "phase", "query")
        },
    )
