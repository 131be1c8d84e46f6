"""A gradient-free search for the computed blocks and the timesteps of a short denoising chain.

Evolution of the kind (mu + lambda) with mu = lambda: of all chains that were tried, the best ones have as many children, which
differ from them in some cells of the mask, in a timestep, or in both, and none costs more than the budget. (For timesteps and
layers searched so for pictures, with another fitness: AutoDiffusion, arXiv:2309.10438.)

A step that is pruned is not for nothing: a stochastic chain draws noise before it, with a standard deviation of 0.15 from
timestep 41 to 40 of DDPM's hundred, and blocks that are not computed cannot take it away.

What was tried is all that a search has to remember: run again with it, it asks nothing twice and ends where it would have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.spacing import timesteps_fall

__all__ = ["ChainSpace", "Evolution", "PrunedChain", "evolve"]

_ROUNDING = 1e-9  # of costs, which are sums
_STRIDES = (1, 2, 5, 10)  # by which a timestep moves


@dataclass(frozen=True)
class PrunedChain:
    """A short denoising chain and its prune mask.

    Attributes:
        timesteps: K falling timesteps.
        rows: K strings with a character for each of the 3L blocks, "1" pruned and "0" computed; the first has no "1".

    Examples:
        >>> PrunedChain((82, 14), ("000", "011")).mask().tolist()
        [[False, False, False], [False, True, True]]
    """

    timesteps: tuple[int, ...]
    rows: tuple[str, ...]

    @classmethod
    def of(cls, timesteps: Sequence[int], mask: np.ndarray | Tensor) -> PrunedChain:
        """Build a chain from a mask bool [K, 3L]."""
        rows = ("".join(str(int(pruned)) for pruned in row) for row in mask.tolist())
        return cls(tuple(timesteps), tuple(rows))

    def mask(self) -> Tensor:
        """Return the prune mask bool [K, 3L]."""
        return torch.tensor([[cell == "1" for cell in row] for row in self.rows])


@dataclass(frozen=True)
class Evolution:
    """Options of a search.

    Attributes:
        population: how many chains have children, and how many children.
        generations: of children.
        seed: of everything random.

    Raises:
        InputError: for a population or a number of generations below 1.
    """

    population: int = 16
    generations: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("population", "generations"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, got {getattr(self, name)}")


class ChainSpace:
    """Search space of chains of several lengths within a budget.

    Args:
        weights: cost of each block of a step, [3L], in any unit.
        budget: what a chain may cost, in unpruned steps, more than 1: the first step prunes nothing. Blocks alone count: a
            step without a computed one costs nothing.
        lengths: numbers of steps K.
        num_train_timesteps: timesteps lie below it.

    Raises:
        InputError: for a budget of 1 or less, no lengths, some below 2 or above ``num_train_timesteps``, or weights that are
            not positive.

    Examples:
        >>> space = ChainSpace([1.0, 1.0, 2.0], budget=1.5, lengths=[2])
        >>> space.cost(PrunedChain((82, 14), ("000", "110")))
        1.5
    """

    def __init__(
        self,
        weights: Sequence[float],
        budget: float,
        lengths: Sequence[int] = (3, 4, 5),
        *,
        num_train_timesteps: int = 100,
    ) -> None:
        if not budget > 1:
            raise InputError(
                f"budget: expected more than 1 step, the first, which prunes nothing, got {budget}"
            )
        for length in lengths:
            if not 2 <= length <= num_train_timesteps:
                raise InputError(f"lengths: expected 2 to {num_train_timesteps} steps, got {length}")
        if not lengths:
            raise InputError("lengths: expected at least one, got none")
        if not min(weights, default=0) > 0:
            raise InputError(f"weights: expected positive numbers, got {weights}")
        self._shares = np.asarray(weights, dtype=np.float64) / np.sum(weights)
        self.budget, self.lengths, self.num_train_timesteps = budget, tuple(lengths), num_train_timesteps

    def cost(self, chain: PrunedChain) -> float:
        """Return the cost of a chain's computed blocks, in unpruned steps."""
        return self._cost(chain.mask().numpy())

    def starts(self, count: int, rng: np.random.Generator) -> Iterator[PrunedChain]:
        """Yield chains of every length in turn: unpruned ones with pruned steps added, then random ones."""
        for number in range(count):
            turn, which = divmod(number, len(self.lengths))
            length = self.lengths[which]
            yield self._widened(length, turn, rng) if turn < self.whole_steps else self.random(rng, length)

    @property
    def whole_steps(self) -> int:
        """Return how many unpruned steps the budget allows."""
        return int(self.budget + _ROUNDING)

    def random(self, rng: np.random.Generator, length: int | None = None) -> PrunedChain:
        """Return a chain at the timesteps of the rule ``logsnr``, with random blocks computed until the budget is used up."""
        length = int(rng.choice(self.lengths)) if length is None else length
        mask = self._all_but_first(length)
        return PrunedChain.of(self._timesteps(length), self._filled(mask, rng))

    def child(self, parent: PrunedChain, rng: np.random.Generator) -> PrunedChain:
        """Return a mutated copy of a chain: some cells, one timestep, or both."""
        what = rng.integers(3)
        timesteps = parent.timesteps if what == 0 else self._moved(parent.timesteps, rng)
        mask = parent.mask().numpy()
        if what != 1:
            mask = self._flipped(mask, rng)
        return PrunedChain.of(timesteps, mask)

    def _all_but_first(self, length: int) -> np.ndarray:
        mask = np.ones((length, len(self._shares)), dtype=bool)
        mask[0] = False
        return mask

    def _widened(self, length: int, turn: int, rng: np.random.Generator) -> PrunedChain:
        """Put pruned steps directly after one of an unpruned chain, and fill the budget up."""
        whole = self._timesteps(min(self.whole_steps, length))
        at = turn % len(whole)
        added = [whole[at] - 1 - number for number in range(length - len(whole))]
        timesteps = [*whole[: at + 1], *added, *whole[at + 1 :]]
        if not timesteps_fall(timesteps, self.num_train_timesteps):
            return self.random(rng, length)
        mask = np.zeros((length, len(self._shares)), dtype=bool)
        mask[at + 1 : at + 1 + len(added)] = True
        return PrunedChain.of(timesteps, self._filled(mask, rng))

    def _timesteps(self, length: int) -> list[int]:
        return Sampler("ddpm", length, self.num_train_timesteps, spacing="logsnr").timesteps.tolist()

    def _moved(self, timesteps: tuple[int, ...], rng: np.random.Generator) -> tuple[int, ...]:
        strides = [stride for size in _STRIDES for stride in (size, -size)]
        moves = [
            moved
            for at, stride in product(range(len(timesteps)), strides)
            if timesteps_fall(
                moved := (*timesteps[:at], timesteps[at] + stride, *timesteps[at + 1 :]),
                self.num_train_timesteps,
            )
        ]
        return moves[rng.integers(len(moves))] if moves else timesteps

    def _flipped(self, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Change some cells, mostly few; prune others, at random, until the budget is kept; every second time, use it up."""
        mask = mask.copy()
        cells = rng.choice(mask[1:].size, size=min(rng.geometric(0.4), mask[1:].size), replace=False)
        mask[1:].flat[cells] ^= True
        for cell in rng.permutation(mask[1:].size):
            if self._fits(mask):
                break
            mask[1:].flat[cell] = True
        return self._filled(mask, rng) if rng.integers(2) else mask

    def _filled(self, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Compute further blocks in random order, all that fit."""
        for cell in rng.permutation(np.flatnonzero(mask)):
            mask.flat[cell] = False
            if not self._fits(mask):
                mask.flat[cell] = True
        return mask

    def _fits(self, mask: np.ndarray) -> bool:
        return self._cost(mask) <= self.budget + _ROUNDING

    def _cost(self, mask: np.ndarray) -> float:
        return float((~mask @ self._shares).sum())


def evolve(
    space: ChainSpace,
    fitness: Callable[[PrunedChain], float],
    options: Evolution,
    *,
    known: Mapping[PrunedChain, float] | None = None,
    on_chain: Callable[[int, int], None] = lambda done, total: None,
    on_generation: Callable[[Mapping[PrunedChain, float]], None] = lambda tried: None,
) -> dict[PrunedChain, float]:
    """Search for the chain with the lowest fitness.

    Args:
        space: the chains.
        fitness: of a chain, smaller is better, and the same whenever it is asked; called once for each.
        options: how long to search.
        known: fitness that was found before, of a search that was interrupted.
        on_chain: called with (chains, all) after each.
        on_generation: called with all that was tried, or known, after each generation.

    Returns:
        The fitness of all chains that were tried, the best first.

    Examples:
        >>> space = ChainSpace([1.0, 1.0, 2.0], budget=1.5, lengths=[2])
        >>> tried = evolve(space, lambda chain: abs(chain.timesteps[1] - 7) + chain.rows[1].count("1"), Evolution(8, 30))
        >>> best = next(iter(tried))
        >>> best.timesteps[1], best.rows[1]
        (7, '001')
    """
    rng = np.random.default_rng(options.seed)
    known, tried = dict(known or {}), {}
    total = options.population * (options.generations + 1)
    for generation in range(options.generations + 1):
        if generation == 0:
            chains = [*space.starts(options.population, rng)]
        else:
            parents = rng.integers(min(options.population, len(tried)), size=options.population)
            chains = [space.child([*tried][parent], rng) for parent in parents]
        for number, chain in enumerate(chains, 1):
            if chain not in known:
                known[chain] = fitness(chain)
            tried[chain] = known[chain]
            on_chain(generation * options.population + number, total)
        tried = dict(
            sorted(tried.items(), key=lambda entry: entry[1])
        )  # stable: of equals the first stays first
        on_generation(known)
    return tried
