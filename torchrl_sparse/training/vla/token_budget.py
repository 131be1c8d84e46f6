"""How many tokens SpecPrune may drop: the smallest alpha that keeps a stated tolerance, instead of one tuned by hand.

The paper (arXiv:2509.05614) sets alpha by hand for each task suite, from 0.6 to 1. Here the queries of recorded episodes are
answered again under each alpha, in their order, so that what one query leaves for the next is there as in a rollout, and their
actions are compared with the dense policy's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.policies.vla.policy import VLAPolicy, with_pruner
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations

__all__ = [
    "BudgetPoint",
    "TokenBudget",
    "demonstrated_queries",
    "measure_errors",
    "measure_success",
    "recorded_queries",
    "replay",
    "smallest_alpha",
]

MEASURES = ("action_error", "success")
Actor = Callable[[TensorDictBase], TensorDictBase]

_FOREVER = 2**31  # environments end an episode themselves


@dataclass(frozen=True)
class BudgetPoint:
    """What one alpha costs and saves.

    Attributes:
        alpha: multiplies SpecPrune's budget.
        kept: visual tokens in a decoder layer, mean over layers and all queries but the first of an episode, which keeps most
            of them whatever alpha is.
        loss: mean absolute difference to the dense policy's normalised actions, or the share of episodes that were lost.
    """

    alpha: float
    kept: float
    loss: float


@dataclass(frozen=True)
class TokenBudget:
    """A calibrated alpha, and what it was chosen from.

    Attributes:
        preset: of `SpecPrune`.
        alpha: the choice.
        measure: what the losses are, ``"action_error"`` or ``"success"``.
        tolerance: the largest loss that was accepted.
        points: all that was tried.
        options: of `SpecPrune`, that differ from the preset's.

    Examples:
        >>> points = (BudgetPoint(0.5, 90.0, 0.03), BudgetPoint(1.0, 150.0, 0.01))
        >>> budget = TokenBudget("paper", smallest_alpha(points, 0.02), "action_error", 0.02, points)
        >>> budget.pruner().options.alpha
        1.0
    """

    preset: str
    alpha: float
    measure: str
    tolerance: float
    points: tuple[BudgetPoint, ...]
    options: dict[str, Any] = field(default_factory=dict)

    def pruner(self) -> SpecPrune:
        """`SpecPrune` at this alpha."""
        return SpecPrune(self.preset, alpha=self.alpha, **self.options)

    def save(self, path: str | Path) -> None:
        """Writes a JSON file that `load` reads."""
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> TokenBudget:
        """What `save` wrote.

        Raises:
            FileNotFoundError, ValueError: naming the file and what is wrong with it.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"token budget: no file {path}")
        try:
            fields = json.loads(path.read_text(encoding="utf-8"))
            points = tuple(BudgetPoint(**point) for point in fields["points"])
            budget = cls(**{**fields, "points": points})
            budget.pruner()
        except (ValueError, TypeError, KeyError) as error:
            names = ", ".join(cls.__dataclass_fields__)
            raise ValueError(f"{path}: expected a token budget with {names}, got: {error}") from error
        return budget


# -- queries -----------------------------------------------------------------------------------------------------------


def recorded_queries(
    policy: VLAPolicy,
    actor: Actor,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
) -> Iterator[list[TensorDictBase]]:
    """The queries, each [], that ``actor`` makes of a dense policy in one episode per seed.

    Args:
        policy: whose inputs are recorded, and the budget that a controller granted.
        actor: a `ChunkExecutor` of ``policy``.
        make_env: called as ``make_env(seeds=[seed])``.
    """
    names = [*policy.in_keys, keys.IS_INIT, keys.TOKEN_BUDGET, keys.FINE]
    for seed in seeds:
        steps = _rollout(actor, make_env, seed)
        yield [*steps[steps[keys.QUERIED].squeeze(-1)].select(*names, strict=False).unbind(0)]


def demonstrated_queries(
    policy: VLAPolicy, demos: InstructedDemonstrations, every: int
) -> Iterator[list[TensorDictBase]]:
    """The same from demonstrations with images, where a query is made ``every`` so many steps; no simulator is needed."""
    observed = [*policy.network.config.cameras, keys.STATE]
    for index, instruction in enumerate(demos.instructions):
        steps = demos.episodes.episode(index)[::every].select(*observed).clone()
        steps[keys.IS_INIT] = torch.arange(len(steps))[:, None] == 0
        yield [step.set(keys.INSTRUCTION, instruction) for step in steps.unbind(0)]


def _rollout(actor: Actor, make_env: Callable[..., EnvBase], seed: int) -> TensorDictBase:
    """One episode [T]."""
    env = make_env(seeds=[seed])
    try:
        return env.rollout(_FOREVER, actor, auto_cast_to_device=True)
    finally:
        env.close()


# -- measuring and choosing --------------------------------------------------------------------------------------------


@torch.no_grad()
def replay(
    policy: VLAPolicy, queries: Sequence[TensorDictBase], pruner: TokenPruner | None
) -> TensorDictBase:
    """Answers an episode's queries in their order, each with what the one before left.

    Returns:
        The policy's ``out_keys`` under ``pruner``, [Q].
    """
    worker = with_pruner(policy, pruner)
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
    pruners: Sequence[SpecPrune],
    n_action_steps: int,
    on_episode: Callable[[], Any] = lambda: None,
) -> list[BudgetPoint]:
    """The mean action error of each pruner over all queries but the first of an episode.

    Args:
        policy: any; its own pruner plays no part.
        episodes: their queries, each [].
        pruners: differing in alpha.
        n_action_steps: actions of a chunk that are executed, and so compared.
        on_episode: called after each episode.

    Raises:
        ValueError: if no episode has a second query.
    """
    if not any(len(queries) > 1 for queries in episodes):
        raise ValueError(
            f"episodes: expected one with at least two queries, got {[len(q) for q in episodes]}"
        )
    normalize = policy.normalizer.normalize_action
    errors, kept = ([[] for _ in pruners] for _ in range(2))
    for queries in episodes:
        dense = normalize(replay(policy, queries, None)[keys.CHUNK])
        for index, pruner in enumerate(pruners):
            answers = replay(policy, queries, pruner)
            difference = normalize(answers[keys.CHUNK]) - dense
            errors[index].append(difference[1:, :n_action_steps].abs().mean((-2, -1)))
            kept[index].append(answers[keys.KEPT][1:])
        on_episode()
    return [
        BudgetPoint(pruner.options.alpha, torch.cat(tokens).mean().item(), torch.cat(error).mean().item())
        for pruner, tokens, error in zip(pruners, kept, errors, strict=True)
    ]


def measure_success(
    policy: VLAPolicy,
    make_actor: Callable[[VLAPolicy], Actor],
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    pruners: Sequence[SpecPrune],
    on_episode: Callable[[], Any] = lambda: None,
) -> list[BudgetPoint]:
    """By how much the success rate of each pruner is below the dense policy's, on the same initial states.

    Args:
        make_actor: called with the policy under each pruner; makes its `ChunkExecutor`.
        make_env, seeds: as of `recorded_queries`.
    """
    rates, kept = [], []
    for pruner in (None, *pruners):
        actor = make_actor(with_pruner(policy, pruner))
        won, tokens = [], []
        for seed in seeds:
            steps = _rollout(actor, make_env, seed)
            won.append(steps["next", keys.SUCCESS].any().item())
            tokens.append(steps[keys.KEPT][steps[keys.QUERIED]][1:])
            on_episode()
        rates.append(sum(won) / len(won))
        kept.append(torch.cat(tokens).mean().item())
    return [
        BudgetPoint(pruner.options.alpha, tokens, rates[0] - rate)
        for pruner, tokens, rate in zip(pruners, kept[1:], rates[1:], strict=True)
    ]


def smallest_alpha(points: Sequence[BudgetPoint], tolerance: float) -> float:
    """The smallest alpha from which on no tried alpha loses more than ``tolerance``.

    Raises:
        ValueError: if even the largest does; the message lists all.
    """
    chosen = None
    for point in sorted(points, key=lambda point: -point.alpha):
        if point.loss > tolerance:
            break
        chosen = point.alpha
    if chosen is None:
        found = ", ".join(f"{point.alpha:g}: {point.loss:.3g}" for point in points)
        raise ValueError(
            f"tolerance: expected a loss of at most {tolerance:g} at the largest alpha, got {found}"
        )
    return chosen
