"""A search for what TTS (arXiv:2605.13316) trains: compute, reuse within the query or recall the query before, cell by cell.

TTS reads the choice off a network that looks at the observation. Here it is one choice for all queries of an episode but the
first, climbed to on recorded queries of whole episodes with the answers of the dense chain known, on some draws of noise, and
judged on others. Beside it, as many attempts that may not recall say what recalling adds. Every mask computes as many blocks of
each type as the one that it began from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.reference import denoise_recalling, first_memory
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import dense_answers

__all__ = ["Choice", "RecallJudge", "climb_choice", "mutate_choice"]


@dataclass(frozen=True)
class Choice:
    """What is done with each cell.

    Attributes:
        mask: bool [K, 3L], True = pruned.
        recalled: bool [K, 3L], those of them that are recalled.
    """

    mask: Tensor
    recalled: Tensor


class RecallJudge:
    """Says how far queries of whole episodes are from the dense chain's, each with the memory that those before it left.

    Args:
        policy: with the sampler that is pruned.
        episodes: recorded queries of each episode, [Q] with ``("diffusion", "cond")``, in their order.
        draws: of noise for each episode.
        n_action_steps: actions of a chunk that are executed.
        reuse: what pruned cells reuse that are not recalled.
        seed: of the noise.

    Raises:
        ValueError: if no episode has a second query.
    """

    def __init__(
        self,
        policy: DiffusionPolicy,
        episodes: list[TensorDictBase],
        *,
        draws: int,
        n_action_steps: int,
        reuse: Reuse,
        seed: int,
    ) -> None:
        if max(map(len, episodes), default=0) < 2:
            raise ValueError("episodes: expected one of two queries or more, got none")
        self._policy, self._reuse = policy, reuse
        first = policy.n_obs_steps - 1
        self._executed = slice(first, first + n_action_steps)
        generator = torch.Generator().manual_seed(seed)
        self._turns: list[tuple[Tensor, Tensor, Tensor]] = []
        dense = policy.with_plan(None, policy.sampler)
        longest_first = sorted(episodes, key=len, reverse=True)
        for turn in range(len(longest_first[0])):
            going_on = [episode[keys.COND][turn] for episode in longest_first if len(episode) > turn]
            cond = torch.stack(going_on).repeat_interleave(draws, dim=0)
            seeds = torch.randint(2**62, (len(cond), 1), generator=generator).to(cond.device)
            asked = TensorDict({keys.COND: cond, keys.SEED: seeds}, [len(cond)])
            self._turns.append((cond, seeds.flatten(), dense_answers(dense, asked)))
        cond, seeds, _ = self._turns[0]
        with torch.no_grad():
            self._first = first_memory(policy.network, policy.sampler, policy.sample_noise(seeds), cond)

    def errors(self, choice: Choice) -> list[Tensor]:
        """Return, for each turn but the first, f32 [B] of the episodes that come to it: mean absolute difference to the dense
        chain's executed actions on the same noise, normalised."""
        memory, errors = self._first, []
        for turn in range(1, len(self._turns)):
            answers, memory = self._answer(turn, choice, memory)
            errors.append((answers - self._turns[turn][2])[:, self._executed].abs().mean(dim=(1, 2)))
        return errors

    @torch.no_grad()
    def _answer(self, turn: int, choice: Choice, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the answers f32 [B, H, A] of a turn, and what it leaves to the next, f32 [B, K, 3L, H, d]."""
        policy, (cond, seeds, _) = self._policy, self._turns[turn]
        mask, recalled = (
            cells.to(cond.device).expand(len(cond), *cells.shape) for cells in (choice.mask, choice.recalled)
        )
        query = policy.network, policy.sampler, policy.sample_noise(seeds), cond, mask, recalled
        return denoise_recalling(*query, memory[: len(cond)], reuse=self._reuse)

    def error(self, choice: Choice) -> float:
        """Return the mean of `errors` over all queries."""
        return torch.cat(self.errors(choice)).mean().item()


def climb_choice(
    judge: RecallJudge,
    start: Choice,
    attempts: int,
    *,
    done: int = 0,
    recalls: bool = True,
    seed: int = 0,
    on_attempt: Callable[[Choice, int], object] = lambda best, done: None,
) -> Choice:
    """Return the best choice of so many attempts, each of which changes a few cells of the best before it.

    Args:
        judge: whose error falls.
        start: where it begins.
        attempts: changes that are tried in all.
        done: so many of them were, and ``start`` was their best: the climb goes on as if it had not been interrupted.
        recalls: False leaves what is recalled as it is, but for cells that change places.
        seed: of the changes.
        on_attempt: called after each with the best so far and how many were tried.
    """
    best, lowest = start, judge.error(start)
    for attempt in range(done, attempts):
        tried = mutate_choice(best, np.random.default_rng([seed, attempt]), recalls=recalls)
        if (error := judge.error(tried)) < lowest:
            best, lowest = tried, error
        on_attempt(best, attempt + 1)
    return best


def mutate_choice(choice: Choice, rng: np.random.Generator, *, recalls: bool) -> Choice:
    """Return a choice that computes as many blocks of each type, most often all but one in the same cells.

    Of one type of block, some computed cells change places with pruned ones; or, where it ``recalls`` and a coin says so, some
    pruned cells recall that did not, or no longer do. The first step is computed whatever happens.

    >>> start = Choice(torch.tensor([[False] * 3, [False, True, True], [True] * 3]), torch.zeros(3, 3, dtype=torch.bool))
    >>> tried = mutate_choice(start, np.random.default_rng(0), recalls=True)
    >>> (tried.mask == start.mask).all().item(), (tried.recalled & tried.mask).sum().item()
    (True, 1)
    """
    kind = int(rng.integers(len(BLOCK_TYPES)))
    mask, recalled = choice.mask.clone(), choice.recalled.clone()
    cells, chosen = (some[1:, kind :: len(BLOCK_TYPES)] for some in (mask, recalled))
    pruned, computed = cells.nonzero().tolist(), (~cells).nonzero().tolist()
    number = int(rng.geometric(0.6))
    if recalls and rng.random() < 0.5:
        for step, layer in _some(pruned, number, rng):
            chosen[step, layer] ^= True
        return Choice(mask, recalled)
    number = min(number, len(pruned), len(computed))
    places = zip(_some(computed, number, rng), _some(pruned, number, rng), strict=True)
    for (step, layer), (other_step, other_layer) in places:
        cells[step, layer], cells[other_step, other_layer] = True, False
        chosen[step, layer], chosen[other_step, other_layer] = bool(chosen[other_step, other_layer]), False
    return Choice(mask, recalled)


def _some(places: list[list[int]], number: int, rng: np.random.Generator) -> list[list[int]]:
    if not places:
        return []
    return [places[index] for index in rng.choice(len(places), min(number, len(places)), replace=False)]
