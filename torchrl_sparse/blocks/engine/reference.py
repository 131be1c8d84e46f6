"""The reference engine: eager, differentiable, and the definition of what a prune mask means.

Every other engine is tested against :func:`denoise`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import Overhead, check_query
from torchrl_sparse.blocks.engine.timing import time_blocks
from torchrl_sparse.blocks.engine.weights import check_weights
from torchrl_sparse.blocks.mask import NetworkSizes, Reuse, block_macs, fixed_macs, num_buffers
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["ComputedRows", "FeatureRecorder", "ReferenceEngine", "denoise"]


class FeatureRecorder:
    """Recorder of what every block adds to the residual stream in every denoising step, detached.

    The published models need about 25 MB per policy call (K=100, L=8, H=10, d=256, f32).

    Examples:
        >>> recorder = FeatureRecorder()
        >>> for step in range(4):
        ...     for block in range(3):
        ...         recorder(step, block, torch.ones(1, 10, 32))
        >>> recorder.features().shape
        torch.Size([3, 4, 1, 10, 32])
    """

    def __init__(self) -> None:
        self._outputs: dict[int, list[Tensor]] = {}

    def __call__(self, step: int, block: int, output: Tensor) -> None:
        """Keep the ``output`` [B, H, d] of ``block``; steps come in execution order."""
        self._outputs.setdefault(block, []).append(output.detach())

    def features(self) -> Tensor:
        """Return everything recorded, [3L, K, B, H, d]."""
        return torch.stack([torch.stack(outputs) for _, outputs in sorted(self._outputs.items())])


def denoise(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    mask: Tensor | None = None,
    *,
    reuse: Reuse = "block",
    guide: Guide | None = None,
    record: Callable[[int, int, Tensor], None] | None = None,
) -> Tensor:
    """Denoise a batch of action chunks, skipping the blocks that ``mask`` prunes.

    For every block ``b`` of every step, per row of the batch: ``d = block_b(x)`` where the mask is False, the
    latest ``d`` of the reuse rule where it is True; ``x = x + d``. Nothing outlives the call. A row of a
    batch equals the row alone up to the rounding of matrix products, which depends on the batch size.

    Args:
        network: the denoiser; gradients flow through it, and to ``noise`` and ``cond``.
        sampler: the denoising steps, K of them.
        noise: f32 [B, K, H, A], standard normal; ``noise[:, 0]`` is the initial sample, ``noise[:, k]`` the
            gaussian of the transition from step k-1 to step k (not read by deterministic samplers).
        cond: encoded observations f32 [B, To, D].
        mask: bool [B, K, 3L], True = pruned, row 0 all False; rows of the batch may differ. None prunes
            nothing.
        reuse: what a pruned block adds, see :mod:`torchrl_sparse.blocks.mask`: ``"block"`` (BAC,
            arXiv:2506.13456), ``"type"`` (SAG, arXiv:2601.12894, one-for-all buffers with
            last-writer-wins) or ``"single"``.
        guide: what every step's clean prediction is guided toward, see `Guide`; None draws nothing.
        record: called with (step, block, output) for every block, output [B, H, d] being what was added.

    Returns:
        normalised actions [B, H, A].

    Raises:
        InputError: naming what was expected and what came, on a wrong shape, a wrong mask or an unknown
        ``reuse``.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> mask = torch.zeros(3, 10, 3, dtype=torch.bool)
        >>> mask[:, 1::2] = True
        >>> noise, cond = torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5)
        >>> denoise(network, Sampler("ddim", 10), noise, cond, mask).shape
        torch.Size([3, 4, 7])
    """
    check_query(network, sampler, noise, cond, mask, reuse, guide)
    computed = ComputedRows(mask)
    latest: list[Tensor | None] = [None] * num_buffers(reuse, network.num_blocks, network.block_types)
    sample, cleans = noise[:, 0], ()
    for step, timestep in enumerate(sampler.timesteps.tolist()):
        x, memory = network.embed(sample), network.memory(timestep, cond)
        for block in range(network.num_blocks):
            slot = block % len(latest)
            output = _block_output(network, block, x, memory, computed.at(step, block), latest[slot])
            latest[slot] = output
            x = x + output
            if record is not None:
                record(step, block, output)
        noise_k = noise[:, step + 1] if step + 1 < sampler.num_inference_steps else None
        eps, before = network.head_out(x), sample
        sample = sampler.step(eps, step, before, noise_k, cleans, guide)
        cleans = sampler.remember(cleans, eps, step, before, guide)
    return sample


def _block_output(
    network: Denoiser,
    block: int,
    x: Tensor,
    memory: Tensor,
    rows: Tensor | bool,
    latest: Tensor | None,
) -> Tensor:
    """Return what ``block`` adds: computed for ``rows`` (True: all, False: none), ``latest`` for the others."""
    if rows is True:
        return network.block(block, x, memory)
    if rows is False:
        return latest
    assert latest is not None  # the first step computes every block of every row
    return latest.index_copy(0, rows, network.block(block, x[rows], memory[rows]))


class ComputedRows:
    """The rows of a batch that compute each block; the mask is copied to the host once.

    Args:
        mask: bool [B, K, 3L], True = pruned; None prunes nothing.
    """

    def __init__(self, mask: Tensor | None) -> None:
        self._computed: Tensor | None = None
        if mask is not None:
            self._device, self._computed = mask.device, ~mask.cpu()
            self._all = self._computed.all(dim=0).tolist()
            self._any = self._computed.any(dim=0).tolist()

    def at(self, step: int, block: int) -> Tensor | bool:
        """Return True if every row computes, False if none does, else the i64 indices of the computing rows."""
        if self._computed is None or self._all[step][block]:
            return True
        if not self._any[step][block]:
            return False
        return self._computed[:, step, block].nonzero().flatten().to(self._device)


class ReferenceEngine:
    """The reference engine: eager and differentiable; reads the network's weights at every policy call.

    Args:
        network: the denoiser.
        sampler: the sampler.

    Raises:
        InputError: if the network has weights without values, on the meta device, or such as are no floating-point numbers.
    """

    name = "reference"
    detail = "eager and differentiable"

    def __init__(self, network: Denoiser, sampler: Sampler) -> None:
        check_weights(network)
        self._network, self._sampler = network, sampler

    def denoise(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None = None,
        reuse: Reuse = "block",
        guide: Guide | None = None,
    ) -> Tensor:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.denoise`; gradients flow."""
        check_weights(self._network)
        return denoise(self._network, self._sampler, noise, cond, mask, reuse=reuse, guide=guide)

    def refresh(self) -> None:
        """Do nothing: no weights are kept between policy calls."""

    @torch.no_grad()
    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_seconds`."""
        network, like = self._network, self._network.like
        x = network.embed(like.new_zeros(1, network.horizon, network.input_dim))
        memory = network.memory(0, like.new_zeros(1, network.n_obs_steps, network.cond_dim))

        def walk(kind: int) -> None:
            for block in range(kind, network.num_blocks, len(network.block_types)):
                network.block(block, x, memory)

        return time_blocks(walk, network.block_types, network.n_layer, repeats, like.device)

    def block_macs(self) -> tuple[int, ...]:
        """Return the published count, see :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_macs`."""
        return block_macs(NetworkSizes.of(self._network))

    def overhead_macs(self) -> Overhead:
        """Return the published count, see :meth:`~torchrl_sparse.blocks.engine.base.Engine.overhead_macs`."""
        return Overhead(fixed_macs(NetworkSizes.of(self._network)), memory=0, query=0)
