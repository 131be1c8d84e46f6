"""The observations that a pruner is trained on, and what the pruned policy should answer to them (SAG, arXiv:2601.12894)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["ANSWER_BATCH", "dense_answers", "make_reference", "with_queries"]

ANSWER_BATCH = 16  # queries that the policy answers at a time


def make_reference(
    policy: DiffusionPolicy,
    demos: Demonstrations,
    *,
    share: float = 0.05,
    target: Literal["teacher", "data"] = "teacher",
    n_action_steps: int = 8,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> TensorDict:
    """A uniform sample of demonstration windows with the actions that a pruned policy should give there.

    Args:
        policy: the dense policy with the sampler that will be pruned.
        demos: demonstrations.
        share: of all windows, in (0, 1]; 5 % as published.
        target: ``"teacher"``: what the dense policy answers on the same noise; ``"data"``: what was demonstrated,
            as published. A regression to data averages over modes; the teacher's answer does not.
        n_action_steps: actions executed of a chunk; decides how far windows reach over an episode's end.
        seed: fixes the sample and its noise.
        on_progress: called with (windows answered, all).

    Returns:
        [N]: ``("diffusion", "cond")`` f32 [N, To, D], ``("diffusion", "seed")`` i64 [N, 1], ``"target"``
        f32 [N, H, A], normalised.

    Raises:
        ValueError: if the share leaves no window.
    """
    network, normalizer = policy.network, policy.normalizer
    if target not in ("teacher", "data"):
        raise ValueError(f"target: expected 'teacher' or 'data', got {target!r}")
    rows = demos.window_rows(network.horizon, network.n_obs_steps, n_action_steps)
    size = round(share * len(rows))
    if not 0 < size <= len(rows):
        raise ValueError(
            f"share: expected at least one of {len(rows)} windows and not more than all, got {share}"
        )
    generator = torch.Generator().manual_seed(seed)
    windows = demos.windows(rows[torch.randperm(len(rows), generator=generator)[:size]], network.n_obs_steps)
    reference = TensorDict(
        {
            keys.COND: normalizer.normalize_state(windows[keys.HISTORY_STATE]),
            keys.SEED: torch.randint(2**62, (size, 1), generator=generator),
            "target": normalizer.normalize_action(windows[keys.ACTION]),
        },
        [size],
    )
    if target == "teacher":
        reference["target"] = dense_answers(policy, reference, on_progress)
    return reference


def with_queries(
    policy: DiffusionPolicy,
    reference: TensorDict,
    queries: TensorDictBase,
    *,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> TensorDict:
    """A reference set together with what was asked in closed loop, in random order.

    A pruned policy comes to states that demonstrations do not hold; as in DAgger (arXiv:1011.0686), the dense policy
    says what it would have done there.

    Args:
        policy: the dense policy with the sampler that will be pruned.
        reference: see :func:`make_reference`.
        queries: [n], with ``("diffusion", "cond")`` f32 [n, To, D] and ``("diffusion", "seed")`` i64 [n, 1].
        seed: of the order.
        on_progress: called with (queries answered, all).

    Returns:
        [N + n], with the keys of ``reference``.
    """
    asked = queries.select(keys.COND, keys.SEED)
    asked["target"] = dense_answers(policy, asked, on_progress)
    together = torch.cat([reference, asked])
    return together[torch.randperm(len(together), generator=torch.Generator().manual_seed(seed))]


def dense_answers(
    policy: DiffusionPolicy,
    reference: TensorDictBase,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tensor:
    """What the dense policy answers, normalised, f32 [N, H, A], whatever its planner.

    Args:
        policy: with the sampler that is asked for.
        reference: [N], with ``("diffusion", "cond")`` f32 [N, To, D] and ``("diffusion", "seed")`` i64 [N, 1].
        on_progress: called with (queries answered, all).
    """
    answers: list[Tensor] = []
    for part in reference.split(ANSWER_BATCH):
        answers.append(policy.denoise(policy.sample_noise(part[keys.SEED].squeeze(-1)), part[keys.COND]))
        on_progress(sum(map(len, answers)), len(reference))
    return torch.cat(answers)
