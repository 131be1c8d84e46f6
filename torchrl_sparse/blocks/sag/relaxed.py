"""Denoising as a differentiable function of pruning gates, to train learned planners.

Its values are those of :func:`torchrl_sparse.blocks.engine.reference.denoise` under the hard mask. Its
gradients are those of the mixture of SAG (arXiv:2601.12894), with the gate ``M`` a real number::

    out_b = (1 - M) d_b + M tau      tau <- out_b      x <- x + out_b

so that the gradient of a gate says how the final actions would change if its block were computed or reused, also
through what later blocks then reuse. SAG and Learning-to-Cache are trained with it. The release of SAG's successor
(TTS, arXiv:2605.13316) keeps what it reuses without its gradient, ``tau <- detach(out_b)``: a gate then learns from what
reusing does at its own place alone, not from what computing it would do for the blocks that reuse it (``detached``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchrl_sparse.blocks.engine.base import check_query
from torchrl_sparse.blocks.engine.reference import ComputedRows
from torchrl_sparse.blocks.mask import Reuse, num_buffers
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["denoise_relaxed", "gumbel_gate", "step_errors", "straight_through_gate"]


def straight_through_gate(logits: Tensor) -> Tensor:
    """Return hard gates with the gradient of ``sigmoid(logits)`` (straight-through estimator, arXiv:1308.3432).

    Args:
        logits: f32 [*B, K, 3L], positive where pruning is preferred.

    Returns:
        f32 of the same shape, exactly 0 or 1 (1 = pruned); row 0 is 0 and has no gradient.

    >>> straight_through_gate(torch.tensor([[3.0, -3.0], [3.0, -3.0]]))
    tensor([[0., 0.],
            [1., 0.]])
    """
    probability = logits.sigmoid()
    # The bracket is exactly zero, so that the sum is exactly the hard value.
    return _spare_first((logits > 0).to(logits.dtype) + (probability - probability.detach()))


def gumbel_gate(logits: Tensor, temperature: float) -> Tensor:
    """Draw hard gates with probability ``sigmoid(logits)``, straight-through Gumbel-softmax (arXiv:1611.01144).

    Args:
        logits: f32 [*B, K, 3L].
        temperature: of the relaxation that the gradient is taken of, > 0.
    """
    uniform = torch.rand_like(logits).clamp(1e-6, 1 - 1e-6)
    return straight_through_gate((logits + uniform.logit()) / temperature)  # the difference of two Gumbels


def _spare_first(gate: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(gate[..., :1, :]), gate[..., 1:, :]], dim=-2)


def denoise_relaxed(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    gate: Tensor,
    *,
    reuse: Reuse = "block",
    explore: float = 1.0,
    checkpointed: bool = False,
    detached: bool = False,
) -> Tensor:
    """Return normalised actions [B, H, A], differentiable with respect to the gates.

    Args:
        network, sampler, noise, cond, reuse: as in :func:`~torchrl_sparse.blocks.engine.reference.denoise`.
        gate: f32 [B, K, 3L] of 0 and 1 (1 = pruned), row 0 all 0, as the functions above make them.
        explore: probability in (0, 1] of evaluating a pruned block nevertheless, to learn how computing it would change the
            result; drawn for the whole batch from torch's global generator. The gradient of those that are drawn is divided by
            it, so that its expectation stays that of evaluating all.
        checkpointed: recompute each denoising step in the backward pass instead of keeping its activations:
            the memory of one step instead of K, for about a third more time.
        detached: keep outputs for reuse without their gradient, see the module.

    Raises:
        InputError: as ``denoise`` does.
    """
    options = _Options(reuse, explore, checkpointed, detached)
    *_, (*_, actions) = _chain(network, sampler, noise, cond, gate, options)
    return actions


def step_errors(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    gate: Tensor,
    *,
    reuse: Reuse = "block",
    explore: float = 1.0,
    checkpointed: bool = False,
    detached: bool = False,
) -> Tensor:
    """Return the error of each denoising step by itself, with gradients cut between the steps.

    Every step starts from the sample and the buffers that the pruned chain reached, detached, and its result is compared
    with a dense step from the same sample, which costs one more forward pass. No gradient runs through more than one
    step: that of a gate leaves out the use of its buffer to later steps, and that later steps repair part of an early
    error. The arguments are those of :func:`denoise_relaxed`.

    Returns:
        f32 [B, K - 1, H, A], absolute differences after the steps 1 .. K-1.
    """
    options = _Options(reuse, explore, checkpointed, detached)
    chain = _chain(network, sampler, noise, cond, gate, options, cut=True)
    errors = []
    for k, (before, cleans, after) in enumerate(chain):
        if k == 0:  # dense by definition
            continue
        with torch.no_grad():
            eps = network(before, sampler.timesteps[k].item(), cond)
            dense = sampler.step(eps, k, before, _transition_noise(noise, k), cleans)
        errors.append((after - dense).abs())
    return torch.stack(errors, dim=1)


class _Options(NamedTuple):
    """Of :func:`denoise_relaxed`."""

    reuse: Reuse
    explore: float
    checkpointed: bool
    detached: bool


def _chain(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    gate: Tensor,
    options: _Options,
    *,
    cut: bool = False,
) -> Iterator[tuple[Tensor, tuple[Tensor, ...], Tensor]]:
    """Yield the sample before each denoising step, the clean predictions that the step reads, and the sample after it."""
    reuse, explore, checkpointed, detached = options
    pruned = gate.detach().bool()
    check_query(network, sampler, noise, cond, pruned, reuse)
    if not 0 < explore <= 1:
        raise InputError(f"explore: expected a probability in (0, 1], got {explore}")
    explored = torch.rand(gate.shape[1:], device=gate.device) < explore
    computed = ComputedRows(pruned & ~explored)
    gate = _scale_gradient(gate, torch.where(pruned, 1 / explore, 1.0))
    slots = num_buffers(reuse, network.num_blocks, network.block_types)
    buffers: tuple[Tensor, ...] = ()
    cleans: tuple[Tensor, ...] = ()
    sample = noise[:, 0]
    for k in range(sampler.num_inference_steps):
        if cut:
            sample = sample.detach()
            cleans, buffers = (tuple(tensor.detach() for tensor in kept) for kept in (cleans, buffers))
        run = _Step(network, sampler, k, cond, _transition_noise(noise, k), computed, slots, detached)
        arguments = (sample, gate[:, k], cleans, buffers)
        after, new_cleans, buffers = (
            checkpoint(run, *arguments, use_reentrant=False) if checkpointed else run(*arguments)
        )
        yield sample, cleans, after
        sample, cleans = after, new_cleans


class _Step:
    """One denoising step as a function of tensors, so that it can be run again in the backward pass."""

    def __init__(
        self,
        network: Denoiser,
        sampler: Sampler,
        k: int,
        cond: Tensor,
        noise: Tensor | None,
        computed: ComputedRows,
        slots: int,
        detached: bool,
    ) -> None:
        self._network, self._sampler, self._k = network, sampler, k
        self._cond, self._noise = cond, noise
        self._computed, self._slots, self._detached = computed, slots, detached

    def __call__(
        self, sample: Tensor, gate: Tensor, cleans: tuple[Tensor, ...], buffers: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Return the next sample, and clean predictions and buffers after the step; ``gate`` is [B, 3L]."""
        network, latest = self._network, list(buffers) or [None] * self._slots
        memory = network.memory(self._sampler.timesteps[self._k].item(), self._cond)
        x = network.embed(sample)
        for block in range(network.num_blocks):
            slot = block % self._slots
            rows = self._computed.at(self._k, block)
            fresh = self._fresh(block, x, memory, rows)
            output = _mix(fresh, rows, gate[:, block, None, None], latest[slot])
            x = x + output
            latest[slot] = output.detach() if self._detached else output
        eps = network.head_out(x)
        after = self._sampler.step(eps, self._k, sample, self._noise, cleans)
        return after, self._sampler.remember(cleans, eps, self._k, sample), tuple(latest)

    def _fresh(self, block: int, x: Tensor, memory: Tensor, rows: Tensor | bool) -> Tensor | None:
        """Return what ``block`` computes for the ``rows`` that do, see `ComputedRows`."""
        if rows is False:
            return None
        return self._network.block(block, *((x, memory) if rows is True else (x[rows], memory[rows])))


def _mix(fresh: Tensor | None, rows: Tensor | bool, gate: Tensor, reused: Tensor | None) -> Tensor:
    """Return ``(1 - M) d + M tau``; rows that did not compute have ``tau``, and tell their gate nothing."""
    if rows is False:
        return reused
    if reused is None:  # in the first step, which computes every block of every row
        return fresh
    whole = fresh if rows is True else reused.index_copy(0, rows, fresh)
    return gate * reused + (1 - gate) * whole


def _scale_gradient(value: Tensor, factor: Tensor) -> Tensor:
    return value.detach() + factor * (value - value.detach())


def _transition_noise(noise: Tensor, k: int) -> Tensor | None:
    return noise[:, k + 1] if k + 1 < noise.shape[1] else None
