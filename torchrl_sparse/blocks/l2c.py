"""Learning-to-Cache (L2C, arXiv:2406.01733) for denoising transformers: a learned schedule, the same for every observation.

One logit for each block of each denoising step, learned through the frozen policy, then cut at one half. Pruned blocks
reuse their own latest output. Two objectives train such gates, and their results are two methods:

* ``l2c_noise``: L2C's own. A demonstrated chunk is noised to a denoising step that computes everything, one step of the
  sampler follows, and the loss is the squared error that the gates make in the noise predicted *there*
  (:func:`noise_errors`). Every other step computes everything, so at most half of the blocks are pruned, and no
  gradient knows the chain or the actions.
* ``l2c``: SAG's objective, the error of the chain's final actions, without the observation. It may prune every step
  but the first and is what tells whether a learned mask is worth looking; L2C did not publish it.

Both weigh sparsity with SAG's term, where L2C has an L1 penalty, so that they can be compared at the same cost.
:mod:`torchrl_sparse.training.pruner.trainer` trains them (``objective``); a mask is kept as a
:class:`~torchrl_sparse.blocks.schedule.CacheSchedule`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["StaticGates", "noise_errors"]


class StaticGates(nn.Module):
    """One logit for each block of each denoising step, positive where it should be pruned; initially all zero.

    Args:
        num_steps: denoising steps K.
        num_blocks: blocks 3L.

    Examples:
        >>> gates = StaticGates(4, 6)
        >>> gates.prune_logits(torch.zeros(7, 2, 5)).shape
        torch.Size([7, 4, 6])
    """

    rate_input = False
    is_static = True

    def __init__(self, num_steps: int, num_blocks: int) -> None:
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(num_steps, num_blocks))

    def prune_logits(self, cond: Tensor, rate: None = None) -> Tensor:
        """Return f32 [B, K, 3L], the same for every observation of ``cond`` [B, To, D]."""
        return self.logits.expand(len(cond), -1, -1)


def noise_errors(
    network: Denoiser,
    sampler: Sampler,
    clean: Tensor,
    noise: Tensor,
    cond: Tensor,
    gate: Tensor,
    step: int,
) -> Tensor:
    """Return how caching changes the predicted noise at one step: L2C's objective before squaring.

    A gate M mixes ``(1 - M) fresh + M cached``, cached being the block's output in the dense step before.

    Args:
        network: the denoiser.
        sampler: the denoising steps; one that remembers clean predictions begins with that of the dense step.
        clean: demonstrated actions, normalised, f32 [B, H, A].
        noise: f32 [B, 2, H, A], standard normal: of the noised actions and of the sampler's step.
        cond: encoded observations f32 [B, To, D].
        gate: f32 [B, 3L], 1 = pruned.
        step: denoising step that is pruned, 1 .. K-1.

    Returns:
        f32 [B, H, A], differentiable in ``gate``.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> query = torch.randn(3, 4, 7), torch.randn(3, 2, 4, 7), torch.randn(3, 2, 5)
        >>> noise_errors(network, Sampler("ddim", 10), *query, torch.zeros(3, 3), step=1).abs().max() < 1e-5
        tensor(True)
    """
    timesteps = sampler.timesteps.to(cond.device)[step - 1 : step + 1]
    with torch.no_grad():
        before = sampler.add_noise(clean, noise[:, 0], timesteps[0].expand(len(clean)))
        eps, cached = _predict(network, before, timesteps[0].item(), cond)
        cleans = sampler.remember((), eps, step - 1, before) * 2
        sample = sampler.step(eps, step - 1, before, noise[:, 1], cleans)
        expected, _ = _predict(network, sample, timesteps[1].item(), cond)
    actual, _ = _predict(network, sample, timesteps[1].item(), cond, cached, gate[..., None, None])
    return actual - expected


def _predict(
    network: Denoiser,
    sample: Tensor,
    timestep: float,
    cond: Tensor,
    cached: list[Tensor] | None = None,
    gate: Tensor | None = None,
) -> tuple[Tensor, list[Tensor]]:
    """Return the predicted noise and what every block added, mixed with ``cached`` by ``gate`` [B, 3L, 1, 1]."""
    x, memory = network.embed(sample), network.memory(timestep, cond)
    outputs = []
    for block in range(network.num_blocks):
        output = network.block(block, x, memory)
        if cached is not None and gate is not None:
            output = gate[:, block] * cached[block] + (1 - gate[:, block]) * output
        x = x + output
        outputs.append(output)
    return network.head_out(x), outputs
