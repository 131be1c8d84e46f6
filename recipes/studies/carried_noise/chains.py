"""Measurement of how strongly a policy's actions depend on the initial noise of the denoising chain.

A deterministic sampler hands the noise that it predicted on to the next step, so that every step sees the same noise, and errs
in the same direction, until the last. A stochastic one draws new noise between steps, and the errors of its clean predictions
average out. What is left is measured on policy calls that are answered many times, with noise that is drawn again each time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["CarriedNoise", "carried_noise"]

_BATCH = 128  # samples that go through the network at a time


@dataclass(frozen=True)
class CarriedNoise:
    """Effect of the initial noise on the executed actions, all normalised.

    Attributes:
        timesteps: of the K steps.
        correlation: of the clean prediction of each step with the noise that its chain began with, over the draws of a
            policy call; the mean over calls and executed numbers; [K].
        spread: standard deviation of the answer over the draws of a call, root mean square.
        error: of the answer against the demonstrated actions, root mean square.
    """

    timesteps: tuple[int, ...]
    correlation: tuple[float, ...]
    spread: float
    error: float


@torch.no_grad()
def carried_noise(
    policy: DiffusionPolicy,
    targets: TensorDictBase,
    sampler: Sampler,
    *,
    draws: int = 16,
    seed: int = 0,
    n_action_steps: int = 8,
    on_progress: Callable[[int], None] = lambda done: None,
) -> CarriedNoise:
    """Answer every policy call ``draws`` times and measure how much the actions depend on the initial noise.

    Args:
        policy: the trained policy; its own sampler and planner do not matter.
        targets: [N], from data, see `torchrl_sparse.training.diffusion.targets.make_targets`.
        sampler: of the chain.
        draws: of noise a call, at least 3.
        seed: of the noise; samplers of as many steps draw the same.
        n_action_steps: actions executed of a chunk.
        on_progress: called with the network calls that were made, in samples.

    Raises:
        InputError: for fewer than three draws or no calls.

    Examples:
        >>> from tensordict import TensorDict
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> targets = {keys.COND: torch.zeros(1, 2, 19), "target": torch.zeros(1, 10, 10)}
        >>> chain = carried_noise(policy, TensorDict(targets, [1]), Sampler("ddim", timesteps=[87, 20]), draws=4)
        >>> chain.timesteps, chain.correlation[0] > 0.1
        ((87, 20), True)
    """
    if draws < 3 or not len(targets):
        raise InputError(f"expected draws >= 3 and policy calls, got {draws} draws of {len(targets)} calls")
    network, target = policy.network, targets["target"]
    generator = torch.Generator().manual_seed(seed)
    shape = (len(targets) * draws, sampler.num_inference_steps, *target.shape[1:])
    cond = targets[keys.COND].repeat_interleave(draws, 0)
    noise = torch.randn(shape, generator=generator).to(cond.device)
    chains = [
        _chain(network, sampler, noise[rows], cond[rows], on_progress)
        for rows in torch.arange(len(noise)).split(_BATCH)
    ]
    first = policy.n_obs_steps - 1
    executed = slice(first, first + n_action_steps)
    # [K + 1, N, draws, n, A]: the clean predictions and, last, the answer
    found = torch.cat(chains, 1).unflatten(1, (-1, draws))[..., executed, :]
    began, wanted = noise[:, 0].unflatten(0, (-1, draws))[..., executed, :], target[:, None, executed]
    return CarriedNoise(
        tuple(sampler.timesteps.tolist()),
        tuple(_correlation(clean, began) for clean in found[:-1]),
        found[-1].var(1).mean().sqrt().item(),
        (found[-1] - wanted).square().mean().sqrt().item(),
    )


def _chain(
    network: torch.nn.Module,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    on_progress: Callable[[int], None],
) -> Tensor:
    """Return the clean predictions of all steps and the answer, [K + 1, B, H, A]."""
    sample, cleans = noise[:, 0], []
    following = [*noise.unbind(1)[1:], None]  # of the transition after each step
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        eps = network(sample, torch.full((len(sample),), timestep, device=sample.device), cond)
        earlier = cleans[::-1][:2]
        cleans.append(sampler.coefficients.clean(k, sample, eps))
        sample = sampler.step(eps, k, sample, following[k], earlier)
        on_progress(len(sample))
    return torch.stack([*cleans, sample])


def _correlation(answers: Tensor, noise: Tensor) -> float:
    """Return the correlation over draws, axis 1, mean over the rest; what does not vary has none."""
    one, other = (values - values.mean(1, keepdim=True) for values in (answers, noise))
    scale = (one.square().mean(1) * other.square().mean(1)).sqrt()
    return torch.where(scale > 0, (one * other).mean(1) / scale.clamp_min(1e-12), 0).mean().item()
