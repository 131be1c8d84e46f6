"""Distance of a method's actions from the demonstrations and from dense's, measured without playing episodes.

A policy's answer is a distribution, of which a policy call shows one draw. Errors of single answers reward a chain that
averages over several good ones; the energy score does not: it is least, in the mean, for answers that are distributed as what
was demonstrated (Gneiting and Raftery, "Strictly Proper Scoring Rules, Prediction, and Estimation", JASA 2007, Eq. 21).
Which of these numbers says how episodes will go is measured by the study ``offline_errors``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import planned_answers

__all__ = ["OfflineErrors", "draw_answers", "energy_scores", "offline_errors"]


@dataclass(frozen=True)
class OfflineErrors:
    """Errors of the executed actions, normalised; means over policy calls and draws.

    Attributes:
        error: absolute difference to the demonstrated actions.
        energy_score: ``E|X - y| - E|X - X'| / 2`` of answers X, X' and the demonstrated actions y of a call, Euclidean.
        energy_distance: ``2 E|X - Y| - E|X - X'| - E|Y - Y'|`` to dense's answers Y; about 0 where both are distributed alike,
            and slightly below it by chance.
        spread: standard deviation of the answers to a call, root mean square.
    """

    error: float
    energy_score: float
    energy_distance: float
    spread: float


def draw_answers(
    policy: DiffusionPolicy, queries, *, draws: int, n_action_steps: int, seed: int = 0
) -> Tensor:
    """Answer every policy call ``draws`` times, each with independent noise.

    Args:
        policy: under the method's sampler and planner.
        queries: [N], with ``("diffusion", "cond")``, see `torchrl_sparse.training.diffusion.targets.make_targets`.
        draws: of noise a call.
        n_action_steps: actions executed of a chunk.
        seed: of the noise.

    Returns:
        f32 [N, draws, n_action_steps * A], normalised.
    """
    many = queries.select(keys.COND).repeat_interleave(draws)
    generator = torch.Generator().manual_seed(seed)
    many[keys.SEED] = torch.randint(2**62, (len(many), 1), generator=generator).to(policy.device)
    first = policy.n_obs_steps - 1
    with torch.no_grad():
        answers = planned_answers(policy, many)[:, first : first + n_action_steps]
    return answers.flatten(1).unflatten(0, (-1, draws))


def offline_errors(answers: Tensor, demonstrated: Tensor, dense: Tensor) -> OfflineErrors:
    """Compare a method's actions with the demonstrated ones and with dense's.

    Args:
        answers: f32 [N, S, D], S >= 2 draws for each of N policy calls.
        demonstrated: f32 [N, D].
        dense: f32 [N, T, D], dense's answers to the same calls; of its own draws, not those of ``answers``.

    Raises:
        InputError: for fewer than two draws.

    Examples:
        >>> draws = torch.tensor([[[0.0], [2.0]]])
        >>> offline_errors(draws, demonstrated=torch.tensor([[1.0]]), dense=draws + 3)
        OfflineErrors(error=1.0, energy_score=0.0, energy_distance=2.0, spread=1.4142135381698608)
    """
    if min(answers.shape[1], dense.shape[1]) < 2:
        raise InputError(
            f"draws: expected at least 2, got {answers.shape[1]} of the method and {dense.shape[1]} of dense"
        )
    across = torch.cdist(answers, dense).mean()
    return OfflineErrors(
        (answers - demonstrated[:, None]).abs().mean().item(),
        energy_scores(answers, demonstrated).mean().item(),
        (2 * across - _mean_distances(answers).mean() - _mean_distances(dense).mean()).item(),
        answers.var(1).mean().sqrt().item(),
    )


def energy_scores(answers: Tensor, demonstrated: Tensor) -> Tensor:
    """Return the energy score of each policy call, f32 [N]; arguments as of `offline_errors`.

    >>> energy_scores(torch.tensor([[[0.0], [2.0]]]), torch.tensor([[5.0]]))
    tensor([3.])
    """
    return torch.cdist(answers, demonstrated[:, None]).mean((1, 2)) - _mean_distances(answers) / 2


def _mean_distances(draws: Tensor) -> Tensor:
    """Return the mean distance of two different draws of each policy call, [N, S, D] -> [N]."""
    count = draws.shape[1]
    return torch.cdist(draws, draws).sum((1, 2)) / (count * (count - 1))
