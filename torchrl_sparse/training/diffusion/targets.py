"""Calibration sets for training gates: observations and target actions for the pruned policy.

The calibration set of SAG (arXiv:2601.12894, Section 3.3), also with the policy calls of the closed loop.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.envs.contract import check_contract
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import describe_differences, parse_json
from torchrl_sparse.training.diffusion.observed import encode_windows

__all__ = [
    "ANSWER_BATCH",
    "add_queries",
    "dense_answers",
    "load_targets",
    "make_targets",
    "planned_answers",
    "save_targets",
]

ANSWER_BATCH = 16  # policy calls that the policy answers at a time


def make_targets(
    policy: DiffusionPolicy,
    demos: Demonstrations,
    *,
    share: float = 0.05,
    source: Literal["teacher", "data"] = "teacher",
    n_action_steps: int = 8,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> TensorDict:
    """Return a uniform sample of demonstration windows with target actions for the pruned policy.

    Args:
        policy: the dense policy with the sampler that will be pruned.
        demos: demonstrations with what the policy observes, see `policy_demos`.
        share: of all windows, in (0, 1]; 5 % as published.
        source: of the actions: ``"teacher"``, the answer of the dense policy on the same noise; ``"data"``, the demonstrated
            ones, as published. A regression to data averages over modes; the teacher's answer does not.
        n_action_steps: actions executed of a chunk; decides how far windows reach over an episode's end.
        seed: fixes the sample and its noise.
        on_progress: called with (windows answered, all).

    Returns:
        [N], where the policy is: ``("diffusion", "cond")`` f32 [N, To, D], ``("diffusion", "seed")`` i64 [N, 1], ``"target"``
        f32 [N, H, A], normalised.

    Raises:
        InputError: if the share leaves no window, or the demonstrations mean something else than what the policy observes.
    """
    network, normalizer = policy.network, policy.normalizer
    check_contract(policy, demos.contract)
    if source not in ("teacher", "data"):
        raise InputError(f"source: expected 'teacher' or 'data', got {source!r}")
    rows = demos.window_rows(network.horizon, network.n_obs_steps, n_action_steps)
    size = round(share * len(rows))
    if not 0 < size <= len(rows):
        raise InputError(
            f"share: expected at least one of {len(rows)} windows and not more than all, got {share}"
        )
    generator = torch.Generator().manual_seed(seed)
    drawn = rows[torch.randperm(len(rows), generator=generator)[:size]]
    windows = demos.windows(drawn, network.n_obs_steps)
    targets = TensorDict(
        {
            keys.COND: encode_windows(policy, windows),
            keys.SEED: torch.randint(2**62, (size, 1), generator=generator),
            "target": normalizer.normalize_action(windows[keys.ACTION].to(policy.device)),
        },
        [size],
    ).to(policy.device)
    if source == "teacher":
        targets["target"] = dense_answers(policy, targets, on_progress)
    return targets


def add_queries(
    policy: DiffusionPolicy,
    targets: TensorDict,
    queries: TensorDictBase,
    *,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> TensorDict:
    """Return targets merged with those of closed-loop policy calls, in random order.

    A pruned policy comes to states that demonstrations do not hold; as in DAgger (arXiv:1011.0686), the dense policy
    gives the targets there.

    Args:
        policy: the dense policy with the sampler that will be pruned.
        targets: see `make_targets`.
        queries: [n], with ``("diffusion", "cond")`` f32 [n, To, D] and ``("diffusion", "seed")`` i64 [n, 1].
        seed: of the order.
        on_progress: called with (calls answered, all).

    Returns:
        [N + n], with the keys of ``targets``.
    """
    asked = queries.select(keys.COND, keys.SEED)
    asked["target"] = dense_answers(policy, asked, on_progress)
    together = torch.cat([targets, asked])
    return together[torch.randperm(len(together), generator=torch.Generator().manual_seed(seed))]


@torch.no_grad()
def dense_answers(
    policy: DiffusionPolicy,
    queries: TensorDictBase,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tensor:
    """Return the dense policy's actions, normalised, f32 [N, H, A], ignoring its planner.

    Args:
        policy: the policy with its sampler.
        queries: [N], with ``("diffusion", "cond")`` f32 [N, To, D] and ``("diffusion", "seed")`` i64 [N, 1].
        on_progress: called with (policy calls answered, all).
    """
    answers: list[Tensor] = []
    for part in queries.split(ANSWER_BATCH):
        answers.append(_answer(policy, part, None))
        on_progress(sum(map(len, answers)), len(queries))
    return torch.cat(answers)


@torch.no_grad()
def planned_answers(policy: DiffusionPolicy, queries: TensorDictBase) -> Tensor:
    """Return the policy's actions under its planner, normalised, f32 [N, H, A]; arguments as in `dense_answers`."""
    parts = queries.select(keys.COND, keys.SEED).split(ANSWER_BATCH)
    return torch.cat([_answer(policy, part, policy.plan(part)[keys.PRUNE_MASK]) for part in parts])


def _answer(policy: DiffusionPolicy, queries: TensorDictBase, mask: Tensor | None) -> Tensor:
    noise = policy.sample_noise(queries[keys.SEED].squeeze(-1))
    return policy.denoise(noise, queries[keys.COND], mask, reuse=policy.plan.reuse)


def save_targets(path: str | Path, targets: TensorDict, made_for: Mapping[str, Any]) -> None:
    """Write targets and their settings ``made_for`` (JSON values) atomically."""
    tensors = dict(targets.flatten_keys("/").items())
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, {"made_for": json.dumps(made_for)})


def load_targets(path: str | Path, made_for: Mapping[str, Any]) -> TensorDict:
    """Load targets written by `save_targets`.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming the file, if it is damaged or was made for something else.
    """
    try:
        with safe_open(path, "pt") as file:
            found = parse_json(
                (file.metadata() or {}).get("made_for", "{}"), dict[str, Any], f"{path}: made_for"
            )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no dict
    except (SafetensorError, ValueError) as error:
        raise InputError(f"{path}: expected a complete safetensors file, got: {error}") from error
    if differing := describe_differences(found, made_for):
        raise InputError(f"{path}: made with other settings: {differing}; choose another out or move it away")
    return TensorDict(tensors, batch_size=[len(tensors["target"])]).unflatten_keys("/")
