"""A search for the cache schedule whose actions match demonstrations best at a given cost, and its comparison with rivals.

What is searched is in `recipes.studies.search_schedule.evolution`; here are its fitness, the file that it goes on from,
and the comparison, on demonstrations that it did not see, with what the same budget buys otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from recipes.studies.offline_errors.errors import draw_answers, energy_scores
from recipes.studies.search_schedule.evolution import ChainSpace, Evolution, PrunedChain, evolve
from torchrl_sparse.blocks.mask import Reuse
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import describe_differences, read_json, to_plain, write_json
from torchrl_sparse.training.diffusion.timesteps import search_timesteps

__all__ = [
    "FITNESSES",
    "Judge",
    "Judged",
    "Tried",
    "chain_schedule",
    "compare",
    "judged_rows",
    "rivals",
    "search_schedule",
]

Fitness = Literal["energy_score", "error"]
FITNESSES: dict[Fitness, Callable[[Tensor, Tensor], Tensor]] = {
    "energy_score": energy_scores,
    "error": lambda answers, wanted: (answers - wanted[:, None]).abs().mean((1, 2)),
}
"""Measure -> what it makes of answers f32 [N, S, D] and demonstrated actions [N, D], f32 [N]; smaller is better."""


@dataclass(frozen=True)
class _Scored:
    """A chain that was tried, and its fitness."""

    timesteps: list[int]
    rows: list[str]
    fitness: float


@dataclass(frozen=True)
class Tried:
    """The content of a ``tried.json``, from which an interrupted search resumes.

    Attributes:
        made_for: what fitness and chains depend on.
        weights: cost of each block of a step, [3L]; measured once for all, where it is a time.
        chains: all that were tried.
    """

    format: Literal["torchrl_sparse.schedule_search/1"]
    made_for: dict[str, Any]
    weights: list[float]
    chains: list[_Scored]


@dataclass(frozen=True)
class Judged:
    """Quality of the actions of one chain; see `OfflineErrors`.

    Attributes:
        cost: of its computed blocks, in unpruned steps.
        over_searched: by how much its energy score exceeds the searched chain's, mean over policy calls.
        standard_error: of that, over calls, as if they were independent.
    """

    cost: float
    error: float
    energy_score: float
    over_searched: float
    standard_error: float


class Judge:
    """Score of a policy's actions on every policy call.

    Args:
        policy: the trained policy; its own sampler and planner do not matter.
        targets: [N], from data, see `torchrl_sparse.training.diffusion.targets.make_targets`.
        draws: of answers to each call.
        n_action_steps: actions executed of a chunk.
        reuse: what pruned blocks add.
        seed: of the noise, the same for all chains of one length.
    """

    def __init__(
        self,
        policy: DiffusionPolicy,
        targets: TensorDict,
        *,
        draws: int = 4,
        n_action_steps: int = 8,
        reuse: Reuse = "block",
        seed: int = 0,
    ) -> None:
        self.policy, self.targets, self.reuse = policy, targets, reuse
        self._drawn = {"draws": draws, "n_action_steps": n_action_steps, "seed": seed}
        first = policy.n_obs_steps - 1
        self._wanted = targets["target"][:, first : first + n_action_steps].flatten(1)

    def scores(self, chain: PrunedChain | None) -> dict[Fitness, Tensor]:
        """Return all measures for each policy call, f32 [N]; None stands for the policy's own unpruned chain."""
        answers = self._answers(chain)
        return {name: measure(answers, self._wanted) for name, measure in FITNESSES.items()}

    def _answers(self, chain: PrunedChain | None) -> Tensor:
        planner, sampler = None, self.policy.sampler
        if chain is not None:
            planner = SchedulePlanner(chain_schedule(self.policy, chain, self.reuse))
            sampler = sampler.variant("ddpm", timesteps=chain.timesteps)
        return draw_answers(self.policy.with_plan(planner, sampler), self.targets, **self._drawn)


def chain_schedule(
    policy: DiffusionPolicy,
    chain: PrunedChain,
    reuse: Reuse = "block",
    settings: Mapping[str, Any] | None = None,
) -> CacheSchedule:
    """Return the cache schedule of a chain; benchmarks find it by its file name."""
    sampler = policy.sampler.variant("ddpm", timesteps=chain.timesteps)
    return CacheSchedule.from_mask(
        chain.mask(),
        method="searched",
        policy=policy.fingerprint,
        sampler=sampler.name,
        reuse=reuse,
        settings=dict(settings or {}),
    )


def search_schedule(
    judge: Judge,
    weights: Callable[[], Tensor],
    path: Path,
    *,
    budget: float,
    lengths: tuple[int, ...],
    fitness: Fitness,
    options: Evolution,
    made_for: Mapping[str, Any],
    on_chain: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[ChainSpace, dict[PrunedChain, float]]:
    """Search for the chain whose actions match demonstrations best, resuming from the file of an earlier search.

    Args:
        judge: of the answers.
        weights: makes the cost of each block of a step, f32 [3L]; called where no file knows it.
        path: of the file, written after each generation.
        budget, lengths: see `ChainSpace`.
        fitness: one of `FITNESSES`.
        options: how long to search.
        made_for: what names the policy, the demonstrations and all settings but ``generations``; JSON values.
        on_chain: called with (chains, all) after each.

    Returns:
        The space, and the fitness of all chains that were tried, the best first.

    Raises:
        InputError: if there is no such space, or naming the file, if it is malformed or was made for something else.
    """
    made_for = to_plain(made_for)
    before = _read(path, made_for)
    costs = weights().tolist() if before is None else before.weights
    space = ChainSpace(costs, budget, lengths, num_train_timesteps=judge.policy.sampler.num_train_timesteps)
    chains = [] if before is None else before.chains
    known = {PrunedChain(tuple(one.timesteps), tuple(one.rows)): one.fitness for one in chains}

    def keep(tried: Mapping[PrunedChain, float]) -> None:
        scored = [_Scored([*chain.timesteps], [*chain.rows], value) for chain, value in tried.items()]
        write_json(path, Tried("torchrl_sparse.schedule_search/1", made_for, costs, scored))

    def mean(chain: PrunedChain) -> float:
        return judge.scores(chain)[fitness].mean().item()

    return space, evolve(space, mean, options, known=known, on_chain=on_chain, on_generation=keep)


def rivals(
    judge: Judge,
    space: ChainSpace,
    best: PrunedChain,
    *,
    fitness: Fitness,
    random_masks: int,
    seed: int = 0,
    on_chain: Callable[[], object] = lambda: None,
) -> dict[str, list[PrunedChain | None]]:
    """Return the chain that was found and the alternatives of the same cost.

    Args:
        judge: of the search.
        space: of the search.
        best: what was found.
        fitness: of the search, by which the timesteps of the unpruned chain are searched too.
        random_masks: how many chains to draw at random, at timesteps of the rule ``logsnr``.
        seed: of their choice.
        on_chain: called for each chain that is asked.

    Returns:
        ``"searched"``; ``"unpruned"``, as many whole steps as the budget has, at searched timesteps; ``"unpruned logsnr"``, at
        those of the rule; ``"random masks"``; and ``"dense"``, the policy's own chain, None.
    """
    whole = Sampler("ddpm", space.whole_steps, space.num_train_timesteps, spacing="logsnr")
    start = tuple(whole.timesteps.tolist())

    def unpruned(timesteps: tuple[int, ...]) -> PrunedChain:
        return PrunedChain(timesteps, ("0" * len(best.rows[0]),) * len(timesteps))

    def mean(timesteps: tuple[int, ...]) -> float:
        on_chain()
        return judge.scores(unpruned(timesteps))[fitness].mean().item()

    moved, _ = search_timesteps(mean, start, num_train_timesteps=space.num_train_timesteps)
    rng = np.random.default_rng(seed)
    return {
        "searched": [best],
        "unpruned": [unpruned(moved)],
        "unpruned logsnr": [unpruned(start)],
        "random masks": [space.random(rng) for _ in range(random_masks)],
        "dense": [None],
    }


def compare(
    judge: Judge,
    space: ChainSpace,
    chains: Mapping[str, list[PrunedChain | None]],
    *,
    on_chain: Callable[[], object] = lambda: None,
) -> dict[str, Judged]:
    """Judge chains by name; chains that share a name count with their mean.

    Args:
        judge: of demonstrations that nothing was searched with.
        space: of the search.
        chains: see `rivals`, the one that was found first.
        on_chain: called for each chain that is asked.
    """

    def measure(some: list[PrunedChain | None]) -> dict[Fitness, Tensor]:
        found = []
        for chain in some:
            on_chain()
            found.append(judge.scores(chain))
        return {name: torch.stack([one[name] for one in found]).mean(0) for name in FITNESSES}

    dense = judge.policy.num_inference_steps
    measured = {name: measure(some) for name, some in chains.items()}
    ours = next(iter(measured.values()))["energy_score"]
    judged = {}
    for name, found in measured.items():
        costs = [dense if chain is None else space.cost(chain) for chain in chains[name]]
        more = found["energy_score"] - ours
        means = (found[key].mean().item() for key in ("error", "energy_score"))
        error = (more.std() / len(more) ** 0.5).item()
        judged[name] = Judged(float(np.mean(costs)), *means, more.mean().item(), error)
    return judged


def judged_rows(judged: Mapping[str, Judged]) -> list[dict[str, str]]:
    """Return the rows of the table of judged chains."""
    return [
        {
            "chain": name,
            "cost, steps": f"{one.cost:.2f}",
            "error": f"{one.error:.4f}",
            "energy score": f"{one.energy_score:.4f}",
            "over searched": f"{one.over_searched:+.4f} ± {one.standard_error:.4f}",
        }
        for name, one in judged.items()
    ]


def _read(path: Path, made_for: dict[str, Any]) -> Tried | None:
    if not path.exists():
        return None
    found = read_json(path, Tried)
    if differing := describe_differences(found.made_for, made_for):
        raise InputError(f"{path}: made with other settings: {differing}; choose another out or move it away")
    return found
