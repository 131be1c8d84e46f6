"""Search for the timesteps of a short denoising chain.

A sampler may stop at any timesteps. The spacing ``"leading"`` in a few steps begins too low for a sample of pure noise
and spends the last step at timestep 0, where hardly any noise is left; ``"logsnr"`` is a rule that mends both without
looking at the policy (`torchrl_sparse.networks.diffusion.spacing`). Which timesteps suit a trained policy can be
measured without training: the error of its actions against demonstrated ones says it, and a descent over single
timesteps finds a minimum (for the same idea with a likelihood instead, see arXiv:2106.03802).

The error ranks chains of one length and one kind only: an average of several good answers also has a small error, the
shorter a chain, the more it averages, and fresh noise adds to the error what it takes from the average. Episodes have
the last word.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.spacing import timesteps_fall
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import dense_answers, planned_answers

__all__ = ["FoundTimesteps", "demonstration_error", "find_timesteps", "planned_error", "search_timesteps"]


def search_timesteps(
    error: Callable[[tuple[int, ...]], float],
    start: Sequence[int],
    *,
    num_train_timesteps: int = 100,
    strides: Sequence[int] = (10, 5, 2),
) -> tuple[tuple[int, ...], dict[tuple[int, ...], float]]:
    """Search by coordinate descent: move the timestep that helps most until no move of any stride helps.

    Args:
        error: of a chain with these timesteps, falling; called once for each.
        start: timesteps to begin with, e.g. diffusers' own.
        num_train_timesteps: timesteps lie below it.
        strides: by how much a timestep moves; the first until it does not help any more, then the next.

    Returns:
        The timesteps of least error and the error of all that were tried.

    Raises:
        InputError: if ``start`` does not fall, or not from below ``num_train_timesteps`` to at least 0.

    Examples:
        >>> best, tried = search_timesteps(lambda steps: abs(steps[0] - 88) + abs(steps[1] - 12), [50, 0])
        >>> best
        (88, 12)
    """
    best = tuple(start)
    if not timesteps_fall(best, num_train_timesteps):
        raise InputError(
            f"start: expected timesteps that fall from below {num_train_timesteps} to at least 0, got {list(start)}"
        )
    tried = {best: error(best)}
    for stride in strides:
        while True:
            moves = [move for move in _moves(best, stride) if timesteps_fall(move, num_train_timesteps)]
            tried |= {move: error(move) for move in moves if move not in tried}
            winner = min([best, *moves], key=tried.__getitem__)
            if winner == best:
                break
            best = winner
    return best, tried


def demonstration_error(
    policy: DiffusionPolicy, targets: TensorDict, sampler: Sampler, *, n_action_steps: int = 8
) -> float:
    """Return the mean absolute error, normalised, of a sampler's executed actions against demonstrated ones.

    Args:
        policy: the trained policy; its own sampler and planner do not matter.
        targets: [N], from data, see `torchrl_sparse.training.diffusion.targets.make_targets`.
        sampler: of the chain; its noise is that of the targets' seeds, the same in every call.
        n_action_steps: actions executed of a chunk.
    """
    chain = DiffusionPolicy(
        policy.network,
        policy.normalizer,
        vision=policy.vision,
        sampler=sampler,
        engine=policy.engine,
    )
    return _executed_error(policy, dense_answers(chain, targets), targets, n_action_steps)


def planned_error(policy: DiffusionPolicy, targets: TensorDict, *, n_action_steps: int = 8) -> float:
    """Return the `demonstration_error` of a policy under its own sampler and planner, with the same arguments."""
    return _executed_error(policy, planned_answers(policy, targets), targets, n_action_steps)


@dataclass(frozen=True)
class FoundTimesteps:
    """Result of `find_timesteps`.

    Attributes:
        sampler: the chain of least error.
        error: its error.
        spacings: spacing -> the timesteps that it takes.
        tried: timesteps -> error, of all chains that were tried, those of the spacings among them.
    """

    sampler: Sampler
    error: float
    spacings: dict[str, tuple[int, ...]]
    tried: dict[tuple[int, ...], float]


def find_timesteps(
    policy: DiffusionPolicy,
    targets: TensorDict,
    kind: str,
    num_inference_steps: int,
    *,
    eta: float = 0.0,
    spacings: Sequence[str] = ("leading", "logsnr"),
    strides: Sequence[int] = (10, 5, 2),
    n_action_steps: int = 8,
    on_chain: Callable[[], object] = lambda: None,
) -> FoundTimesteps:
    """Search for the timesteps whose actions are closest to demonstrations, starting from the best spacing rule.

    Args:
        policy: the trained policy; its own sampler and planner do not matter.
        targets: [N], from data, see `torchrl_sparse.training.diffusion.targets.make_targets`.
        kind, num_inference_steps, eta: of the sampler.
        spacings: compared with the search, which begins at the best of them.
        strides: see `search_timesteps`.
        n_action_steps: actions executed of a chunk.
        on_chain: called before each chain that is tried.

    Raises:
        InputError: if there is no such sampler.
    """
    train_steps = policy.sampler.num_train_timesteps

    def chain(**where) -> Sampler:
        return policy.sampler.variant(kind, eta=eta, **where)

    @cache
    def error(timesteps: tuple[int, ...]) -> float:
        on_chain()
        return demonstration_error(policy, targets, chain(timesteps=timesteps), n_action_steps=n_action_steps)

    starts = {
        spacing: tuple(chain(num_inference_steps=num_inference_steps, spacing=spacing).timesteps.tolist())
        for spacing in spacings
    }
    start = min(starts.values(), key=error)
    best, tried = search_timesteps(error, start, num_train_timesteps=train_steps, strides=strides)
    tried |= {timesteps: error(timesteps) for timesteps in starts.values()}
    return FoundTimesteps(chain(timesteps=best), tried[best], starts, tried)


def _executed_error(
    policy: DiffusionPolicy, answers: Tensor, targets: TensorDict, n_action_steps: int
) -> float:
    first = policy.n_obs_steps - 1
    executed = slice(first, first + n_action_steps)
    return (answers - targets["target"])[:, executed].abs().mean().item()


def _moves(timesteps: tuple[int, ...], stride: int) -> list[tuple[int, ...]]:
    return [
        (*timesteps[:i], timestep + move, *timesteps[i + 1 :])
        for i, timestep in enumerate(timesteps)
        for move in (stride, -stride)
    ]
