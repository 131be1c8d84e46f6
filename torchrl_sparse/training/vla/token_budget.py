"""Calibration measurements of token pruners: action error or lost success at each token budget.

`torchrl_sparse.methods.token_budget` chooses. The policy calls of recorded episodes are answered again under each number, in
their order, so that what one call leaves for the next is there as in a rollout, and their actions are compared with the dense
policy's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.envs.transforms import twists
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.token_budget import BudgetPoint
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations

__all__ = ["demonstrated_queries", "measure_errors", "measure_success", "recorded_queries", "replay"]

Actor = Callable[[TensorDictBase], TensorDictBase]

_FOREVER = 2**31  # environments end an episode themselves
_BESIDE = (keys.IS_INIT, keys.EPISODE_SEED, keys.EPISODE_STEP, keys.EEF_VEL, keys.TOKEN_BUDGET, keys.FINE)


# -- policy calls -----------------------------------------------------------------------------------------------------------


def recorded_queries(
    policy: VLAPolicy,
    actor: Actor,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
) -> Iterator[list[TensorDictBase]]:
    """Record the policy calls, each [], of a dense policy under ``actor``, in one episode per seed.

    Args:
        policy: whose inputs are recorded, with what pruners and controllers read beside them, and what a controller granted.
        actor: a `ChunkExecutor` of ``policy``.
        make_env: called as ``make_env(seeds=[seed])``.
    """
    names = [*policy.in_keys, *_BESIDE]
    for seed in seeds:
        steps = _rollout(actor, make_env, seed)
        yield [*steps[steps[keys.QUERIED].squeeze(-1)].select(*names, strict=False).unbind(0)]


def demonstrated_queries(
    policy: VLAPolicy,
    demos: InstructedDemonstrations,
    every: int,
    poses: Sequence[tuple[slice, slice]],
    control_freq: float = 20.0,
) -> Iterator[list[TensorDictBase]]:
    """Build policy calls from demonstrations with images, one per ``every`` steps; needs no simulator.

    The hand's velocity, which demonstrations do not keep, is that of the step before each call, as `EndEffectorVelocity`'s;
    an episode's seed is its place in the file, so that a pruner that draws tokens draws the same ones each time.

    Args:
        policy: whose inputs are taken.
        demos: whose states are the policy's.
        every: steps from one call to the next.
        poses: for each arm, where its position and its quaternion (xyzw) lie in the state.
        control_freq: steps a second.
    """
    observed = [*policy.network.config.cameras, keys.STATE]
    for index, instruction in enumerate(demos.instructions):
        steps = demos.episodes.episode(index).select(*observed).clone()
        state = steps[keys.STATE]
        before = torch.cat([state[:1], state[:-1]])  # an episode begins at rest
        steps[keys.EEF_VEL] = twists(before, state, poses) * control_freq
        steps[keys.EPISODE_STEP] = torch.arange(len(steps))[:, None]
        steps[keys.EPISODE_SEED] = torch.full((len(steps), 1), index)
        steps = steps[::every]
        steps[keys.IS_INIT] = steps[keys.EPISODE_STEP] == 0
        yield [step.set(keys.INSTRUCTION, instruction) for step in steps.unbind(0)]


def _rollout(actor: Actor, make_env: Callable[..., EnvBase], seed: int) -> TensorDictBase:
    """Run one episode, [T]."""
    env = make_env(seeds=[seed])
    try:
        return env.rollout(_FOREVER, actor, auto_cast_to_device=True)
    finally:
        env.close()


# -- measuring -------------------------------------------------------------------------------------------------------


@torch.no_grad()
def replay(
    policy: VLAPolicy, queries: Sequence[TensorDictBase], pruner: TokenPruner | None
) -> TensorDictBase:
    """Answer an episode's policy calls in order, each with the keys carried from the previous one.

    Returns:
        The policy's ``out_keys`` under ``pruner``, [Q].
    """
    worker = policy.with_pruner(pruner)
    carried: list[NestedKey] = [key for key in worker.out_keys if key in worker.in_keys]
    device = next(policy.network.parameters()).device
    answers, left = [], TensorDict({}, [])
    for recorded in queries:
        answer = worker(recorded.exclude(*carried).to(device).update(left))
        left = answer.select(*carried)
        answers.append(answer.select(*worker.out_keys))
    return torch.stack(answers)


def measure_errors(
    policy: VLAPolicy,
    episodes: Sequence[Sequence[TensorDictBase]],
    pruners: Mapping[float, TokenPruner],
    n_action_steps: int,
    on_episode: Callable[[], Any] = lambda: None,
) -> list[BudgetPoint]:
    """Measure the mean action error of each pruner over all policy calls except an episode's first.

    Args:
        policy: any; its own pruner plays no part.
        episodes: their calls, each [].
        pruners: number -> pruner.
        n_action_steps: actions of a chunk that are executed, and so compared.
        on_episode: called after each episode.

    Raises:
        InputError: if no episode has a second call.
    """
    if not any(len(queries) > 1 for queries in episodes):
        raise InputError(
            f"episodes: expected one with at least two policy calls, got {[len(q) for q in episodes]}"
        )
    normalize = policy.normalizer.normalize_action
    errors, kept = ({number: [] for number in pruners} for _ in range(2))
    for queries in episodes:
        dense = normalize(replay(policy, queries, None)[keys.CHUNK])
        for number, pruner in pruners.items():
            answers = replay(policy, queries, pruner)
            difference = normalize(answers[keys.CHUNK]) - dense
            errors[number].append(difference[1:, :n_action_steps].abs().mean((-2, -1)))
            kept[number].append(answers[keys.KEPT][1:])
        on_episode()
    return [
        BudgetPoint(number, torch.cat(kept[number]).mean().item(), torch.cat(errors[number]).mean().item())
        for number in pruners
    ]


def measure_success(
    policy: VLAPolicy,
    make_actor: Callable[[VLAPolicy], Actor],
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    pruners: Mapping[float, TokenPruner],
    on_episode: Callable[[], Any] = lambda: None,
) -> list[BudgetPoint]:
    """Measure how much each pruner's success rate falls below the dense policy's on the same initial states.

    Args:
        make_actor: called with the policy under each pruner; makes its `ChunkExecutor`.
        make_env, seeds: as of `recorded_queries`.
    """
    rates, kept = [], []
    for pruner in (None, *pruners.values()):
        actor = make_actor(policy.with_pruner(pruner))
        won, tokens = [], []
        for seed in seeds:
            steps = _rollout(actor, make_env, seed)
            won.append(steps["next", keys.SUCCESS].any().item())
            tokens.append(steps[keys.KEPT][steps[keys.QUERIED]][1:])
            on_episode()
        rates.append(sum(won) / len(won))
        kept.append(torch.cat(tokens).mean().item())
    return [
        BudgetPoint(number, tokens, rates[0] - rate)
        for number, tokens, rate in zip(pruners, kept[1:], rates[1:], strict=True)
    ]
