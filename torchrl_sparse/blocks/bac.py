"""BAC: block-wise adaptive caching (arXiv:2506.13456, ICLR 2026).

Calibration records every block's output during dense policy calls. The *adaptive caching scheduler* (ACS) picks,
for each block on its own, the M denoising steps that compute it. The *bubbling union algorithm* (BUA) then
lets the blocks of highest error compute whenever a downstream FFN does, since an FFN that is updated on a
stale input amplifies its error.

Where print and release differ:

* Step indices are in execution order; a pruned block reuses its most recent output.
* The printed recursion of ACS telescopes (every schedule scores the same) and is not offered.
  ``objective="anchor"`` is what the release computes; ``"consecutive"`` is the printed objective, whose
  optimum computes the steps that resemble their predecessor least.
* The release always computes the last step, but by its index 99; here ``force_last`` works for any K.
* The release skips BUA if fewer than two blocks are selected or anything fails; here it runs, or raises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from torchrl_sparse.blocks.calibration import Calibration, calibrate
from torchrl_sparse.blocks.mask import BLOCK_TYPES, block_name
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.errors import InputError

__all__ = [
    "BAC",
    "SCHEDULES",
    "Calibration",
    "acs",
    "bac_blockwise_schedule",
    "bac_schedule",
    "bac_unified_schedule",
    "bubbling_union",
    "calibrate",
    "upstream_blocks",
]

Objective = Literal["anchor", "consecutive"]


def acs(similarity: Tensor, num_updates: int, objective: Objective = "anchor") -> tuple[int, ...]:
    """Choose the best ``num_updates`` denoising steps at which to compute one block; step 0 is always included.

    * ``"anchor"``: maximise ``Σ_m Σ_{t=c_m}^{c_{m+1}-1} S[c_m, t]``, the similarity of every step to the
      update that it reuses. Dynamic programme over the end of the m-th interval, ``D[m][i] = max_{j<i}
      D[m-1][j] + W(j+1, i)`` with ``W(a, b) = Σ_{t=a..b} S[a, t]``; the first of equal maxima wins.
    * ``"consecutive"``: maximise ``Σ S[t-1, t]`` over the reused steps, i.e. compute where consecutive
      outputs differ most; the earlier of equal steps wins.

    Args:
        similarity: float [K, K], higher is more alike; only the upper triangle is read.
        num_updates: computed steps M, 1 to K; K computes all.
        objective: what is maximised.

    Returns:
        M increasing steps in execution order.

    Raises:
        InputError: on a matrix that is not square or not finite, M out of range or an unknown objective.

    Examples:
        >>> similarity = torch.eye(6)
        >>> similarity[0, :3] = similarity[3, 3:] = 1
        >>> acs(similarity, 2)
        (0, 3)
    """
    if similarity.ndim != 2 or similarity.shape[0] != similarity.shape[1]:
        raise InputError(f"similarity: expected a square matrix [K, K], got shape {list(similarity.shape)}")
    if not similarity.isfinite().all():
        raise InputError("similarity: expected finite values, got NaN or infinity")
    if not 1 <= num_updates <= len(similarity):
        raise InputError(f"num_updates: expected 1..{len(similarity)} (K), got {num_updates}")
    if objective == "anchor":
        return _anchored(similarity.double(), num_updates)
    if objective == "consecutive":
        change = similarity.diagonal(offset=1).argsort(stable=True)[: num_updates - 1] + 1
        return (0, *sorted(change.tolist()))
    raise InputError(f'objective: expected "anchor" or "consecutive", got {objective!r}')


def _anchored(similarity: Tensor, num_updates: int) -> tuple[int, ...]:
    num_steps = len(similarity)
    below = torch.ones_like(similarity, dtype=torch.bool).tril(-1)
    # reward[a, b] = W(a, b); an interval cannot end before it starts.
    reward = similarity.triu().cumsum(dim=1).masked_fill(below, -torch.inf)
    best, previous_ends = reward[0], []
    for _ in range(num_updates - 1):
        candidates = best[:-1, None] + reward[1:]  # [j, i]: intervals so far end at j, the next one is j+1..i
        best, previous_end = candidates.max(dim=0)  # of equal maxima, max returns the first
        previous_ends.append(previous_end)
    updates, end = [], num_steps - 1
    for previous_end in reversed(previous_ends):
        end = int(previous_end[end])
        updates.append(end + 1)
    return (0, *reversed(updates))


def upstream_blocks(errors: Tensor | Sequence[float], top_k: int) -> tuple[int, ...]:
    """Return the set U of BUA: columns of the ``top_k`` highest error scores, ascending; ties go to the shallower block.

    >>> upstream_blocks([0.1, 0.3, 0.2], top_k=2)
    (1, 2)
    """
    errors = torch.as_tensor(errors)
    if errors.ndim != 1 or not errors.isfinite().all():
        raise InputError(f"errors: expected finite scores [3L], got {errors.tolist()}")
    if not 0 <= top_k <= len(errors):
        raise InputError(f"top_k: expected 0..{len(errors)} (3L blocks), got {top_k}")
    return tuple(sorted(errors.argsort(descending=True, stable=True)[:top_k].tolist()))


def bubbling_union(
    schedules: Sequence[Sequence[int]],
    errors: Tensor | Sequence[float],
    top_k: int = 5,
    types: Sequence[str] = BLOCK_TYPES,
) -> tuple[tuple[int, ...], ...]:
    """Compute the blocks of highest error whenever a downstream FFN is computed (BUA).

    ``C(u) ← C(u) ∪ ⋃_{v∈D(u)} C(v)`` for every u in U, the ``top_k`` blocks of highest error (FFNs included);
    D(u) are the FFNs of u's own layer and deeper. Afterwards C(u) ⊇ C(v) for every v in D(u). The order does not
    matter: D(v) ⊂ D(u) for every v in D(u), so that u copies all that v could gain anyway.

    Args:
        schedules: computed steps of the 3L blocks in column order.
        errors: error scores [3L], see :func:`~torchrl_sparse.blocks.calibration.block_error`.
        top_k: size of U; 0 changes nothing.
        types: blocks of a layer.

    Returns:
        the new schedules, in column order.

    Raises:
        InputError: if ``errors`` does not have one finite score per schedule or ``top_k`` is out of range.

    Examples:
        >>> bubbling_union([[0, 1], [0, 2], [0, 3]], errors=[9.0, 0.0, 1.0], top_k=1)
        ((0, 1, 3), (0, 2), (0, 3))
    """
    if len(schedules) != len(errors) or len(schedules) % len(types):
        raise InputError(
            f"errors: expected one score per schedule ({len(types)}L), got {len(errors)} for {len(schedules)} schedules"
        )
    merged = [set(steps) for steps in schedules]
    for block in upstream_blocks(errors, top_k):
        own_ffn = block - block % len(types) + types.index("FFN")
        merged[block] = merged[block].union(*merged[own_ffn :: len(types)])
    return tuple(tuple(sorted(steps)) for steps in merged)


def bac_blockwise_schedule(
    calibration: Calibration,
    num_updates: int = 10,
    *,
    policy: str,
    objective: Objective = "anchor",
    force_last: bool = True,
) -> CacheSchedule:
    """Make the schedule of the ablation ``bac_blockwise`` (Table 2, "block-wise ACS"): ACS for every block, without BUA.

    Arguments: :func:`bac_schedule`.
    """
    steps = [
        _with_last(acs(block, num_updates, objective), block, force_last) for block in calibration.similarity
    ]
    settings = {"num_updates": num_updates, "objective": objective, "force_last": force_last}
    return _schedule("bac_blockwise", calibration, policy, steps, settings)


def bac_unified_schedule(
    calibration: Calibration,
    num_updates: int = 10,
    *,
    policy: str,
    objective: Objective = "anchor",
    force_last: bool = True,
) -> CacheSchedule:
    """Make the schedule of the ablation ``bac_unified`` (Table 2, "unified ACS"): ACS of the mean similarity for all blocks.

    Arguments: :func:`bac_schedule`.
    """
    mean = calibration.similarity.mean(dim=0)
    steps = [_with_last(acs(mean, num_updates, objective), mean, force_last)] * len(calibration.similarity)
    settings = {"num_updates": num_updates, "objective": objective, "force_last": force_last}
    return _schedule("bac_unified", calibration, policy, steps, settings)


def bac_schedule(
    calibration: Calibration,
    num_updates: int = 10,
    *,
    policy: str,
    objective: Objective = "anchor",
    force_last: bool = True,
    top_k: int = 5,
) -> CacheSchedule:
    """Make the schedule of the method itself, ``bac``: ACS for every block, then BUA.

    Args:
        calibration: of the policy, see :func:`calibrate`.
        num_updates: computed steps M of each block before BUA; the paper's S, 7 or 10 for K=100. K computes
            everything.
        policy: fingerprint of the policy.
        objective: of :func:`acs`.
        force_last: also compute the last denoising step, as the release does: then a block is computed up to
            M+1 times.
        top_k: blocks that BUA enlarges; the paper's value is 5.

    Raises:
        InputError: as :func:`acs` and :func:`bubbling_union` do.
    """
    alone = bac_blockwise_schedule(
        calibration, num_updates, policy=policy, objective=objective, force_last=force_last
    )
    steps = bubbling_union(alone.computed_steps, calibration.errors, top_k, calibration.block_types)
    types = calibration.block_types
    upstream = [block_name(block, types) for block in upstream_blocks(calibration.errors, top_k)]
    settings = {**alone.settings, "top_k": top_k, "upstream_blocks": upstream}
    return _schedule("bac", calibration, policy, steps, settings)


SCHEDULES = {
    "bac": bac_schedule,
    "bac_blockwise": bac_blockwise_schedule,
    "bac_unified": bac_unified_schedule,
}
"""The method and its ablations by name."""


class BAC(SchedulePlanner):
    """Planner that writes a BAC schedule, or one of its ablations', for every observation.

    Args:
        schedule: what a function of :data:`SCHEDULES` made.

    Raises:
        InputError: if the schedule was made by another method.
    """

    def __init__(self, schedule: CacheSchedule) -> None:
        super().__init__(schedule)
        if self.schedule.method not in SCHEDULES:
            raise InputError(
                f"BAC: expected a schedule of {sorted(SCHEDULES)}, got one of {self.schedule.method!r}"
            )


def _with_last(steps: tuple[int, ...], similarity: Tensor, force_last: bool) -> tuple[int, ...]:
    last = len(similarity) - 1
    return (*steps, last) if force_last and steps[-1] != last else steps


def _schedule(
    method: str,
    calibration: Calibration,
    policy: str,
    steps: Sequence[tuple[int, ...]],
    settings: dict[str, Any],
) -> CacheSchedule:
    num_blocks, num_steps = calibration.similarity.shape[:2]
    settings = {**settings, "num_calibration_samples": calibration.num_samples}
    return CacheSchedule(
        method,
        policy,
        num_steps,
        num_blocks // len(calibration.block_types),
        tuple(steps),
        calibration.sampler,
        settings=settings,
        block_types=calibration.block_types,
    )
