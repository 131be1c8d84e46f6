"""The native engine: one call of compiled code for each action chunk, on the CPU.

``sampler.h`` holds the loop and ``team.h`` the threads, :mod:`~torchrl_sparse.blocks.engine.native.packing` prepares the
weights and tables that they read, and :mod:`~torchrl_sparse.blocks.engine.native.library` finds the compiled code. It reads
the mask as it goes: unlike the PyTorch engine's, its program is the mask.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import byref
from functools import partial

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import Overhead, check_query
from torchrl_sparse.blocks.engine.costs import folded_block_macs, folded_overhead_macs
from torchrl_sparse.blocks.engine.native.arena import PANEL
from torchrl_sparse.blocks.engine.native.layout import CONSTANTS, Units
from torchrl_sparse.blocks.engine.native.library import INSTRUCTION_SETS, instruction_level, loaded
from torchrl_sparse.blocks.engine.native.packing import PackedNetwork, weight_type
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.engine.native.weights import SharedWeights
from torchrl_sparse.blocks.engine.timing import time_blocks
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, num_buffers
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.sizes import check_size

__all__ = ["MAX_THREADS", "NativeEngine"]

MAX_THREADS = CONSTANTS["MAX_THREADS"]  # of a team, see team.h


class NativeEngine:
    """Engine that runs policy calls in compiled code. Not differentiable.

    The weights are packed when the first engine of a network is made, and again when the network's have changed (see
    :class:`~torchrl_sparse.blocks.engine.weights.WeightWatch`); all engines of the network share them. A row of a batch is
    computed exactly as it would be alone, and with the same sums in the same order on any number of threads. Of a batch every
    thread takes whole rows; rows that are left and fewer than threads are each computed by all threads together, as a single
    call is.

    Calls from several threads, and to several engines, may overlap: one of them has the threads, the others run in the
    caller's. Between calls the threads sleep.

    Args:
        network: the denoiser, in eval mode; see `native_supports`.
        sampler: the sampler.
        weights: ``"float32"``; ``"float16"`` for half the memory; ``"bfloat16"`` for half the memory and, on a CPU
            with AMX or AVX512-BF16, twice the multiply-adds, with activations rounded to bfloat16 as well; ``"int8"`` for a
            quarter of the memory and, with AVX512-VNNI, four times the multiply-adds: weights of the trunk are rounded to
            8 bits by output, activations by token between the least and the largest of it, so that no data are needed
            to calibrate them; embedding, head, norms, softmax, cross-attention and the residual stream stay float32.
        instruction_set: one of ``INSTRUCTION_SETS``; None takes the widest that the CPU has.
        threads: with the caller's; None takes ``torch.get_num_threads()`` at each call, of which a single call uses
            no more than one for each 32 of the embedding's size, and none at 1.

    Attributes:
        name: ``"native"``.
        detail: instruction set, weight type and the threads of a single call.

    Raises:
        InputError: if the engine cannot run the network or the instruction set, with the reason.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> if native_supports(network)[0]:
        ...     engine = NativeEngine(network, Sampler("ddim", 10))
        ...     actions = engine.denoise(torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5))
        ...     assert actions.shape == (3, 4, 7)
    """

    name = "native"

    def __init__(
        self,
        network: TransformerForDiffusion,
        sampler: Sampler,
        *,
        weights: str = "float32",
        instruction_set: str | None = None,
        threads: int | None = None,
    ) -> None:
        supported, reason = native_supports(network)
        if not supported:
            raise InputError(f"native engine: {reason}")
        if not sampler.coefficients.sample_share:
            raise InputError(
                'native engine: it reads predicted noise or velocities, the sampler has prediction="sample"'
            )
        if threads is not None:
            check_size("threads", threads, MAX_THREADS)
        self._network, self._sampler, self._weights, self._threads = network, sampler, weights, threads
        self._shared = SharedWeights.of(network, weight_type(weights))
        self._level = instruction_level(instruction_set)
        self._dense = torch.zeros(
            sampler.num_inference_steps, network.num_blocks, dtype=torch.bool, device="cpu"
        )
        self._stock: list[Tensor] = []
        self._packed: PackedNetwork | None = None
        self._current()

    def __reduce__(self) -> tuple:
        """Let copies and pickles pack the weights of their own network."""
        again = partial(
            NativeEngine,
            weights=self._weights,
            threads=self._threads,
            instruction_set=INSTRUCTION_SETS[self._level],
        )
        return again, (self._network, self._sampler)

    @property
    def detail(self) -> str:
        threads = self._num_threads(rows=1)
        team = f"{threads} thread{'s' if threads > 1 else ''}"
        return f"{INSTRUCTION_SETS[self._level]}, {self._weights} weights, {team}"

    def denoise(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None = None,
        reuse: Reuse = "block",
        guide: Guide | None = None,
    ) -> Tensor:
        """Return normalised actions f32 [B, H, A], see :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`.

        Raises:
            InputError: also if the mask is not on the CPU, or if the network is in training mode or was converted or moved.
        """
        check_query(self._network, self._sampler, noise, cond, mask, reuse, guide)
        self._check(mask)
        packed, slots = self._current(), num_buffers(reuse, self._dense.shape[1])
        if mask is None:
            mask = self._dense.expand(len(cond), -1, -1)
        packed.check(noise=noise, cond=cond, mask=mask)
        actions = noise.new_empty(len(cond), *noise.shape[2:])
        if not len(cond):
            return actions
        mask, noise, cond = mask.contiguous(), noise.contiguous(), cond.contiguous()
        drawn = [None, None] if guide is None else [part.contiguous() for part in guide]
        guides = [None if part is None else part.data_ptr() for part in drawn]
        threads = self._num_threads(len(cond))
        query = mask.data_ptr(), slots, noise.data_ptr(), cond.data_ptr(), *guides, actions.data_ptr()
        with self._scratch(packed, threads) as scratch:
            where = self._level, threads, byref(packed.model)
            loaded().sparse_denoise(*where, len(cond), *query, scratch.data_ptr())
        return actions

    def condition(self, state: Tensor, scales: Units) -> Tensor | None:
        """Return the condition f32 [B, To, D] of states in environment units, rounded as PyTorch does.

        Args:
            state: f32 [B, To, D].
            scales: `units` of a normaliser with f32 buffers on the CPU.

        Returns:
            None if a state is not finite.
        """
        state = state.contiguous()
        cond, (rows, steps, dim) = torch.empty(state.shape, dtype=state.dtype, device="cpu"), state.shape
        where = state.data_ptr(), cond.data_ptr()
        finite = loaded().sparse_normalise(byref(scales), rows * steps, dim, *where)
        return cond if finite else None

    def ready(self, noise: Tensor, cond: Tensor) -> PackedNetwork:
        """Return what :meth:`answer` needs from the network, with its current weights.

        Raises:
            InputError: if a policy call does not fit them, or naming a weight that cannot be packed.
        """
        packed = self._current()
        packed.check(noise=noise, cond=cond)
        return packed

    def answer(
        self,
        packed: PackedNetwork,
        noise: Tensor,
        cond: Tensor,
        scales: Units,
        mask: Tensor,
        chunks: Tensor,
        reuse: Reuse = "block",
    ) -> None:
        """Write chunks in environment units, rounded as PyTorch does, in one native call.

        Args:
            packed: see :meth:`ready`.
            noise: f32 [B, K, H, A].
            cond: f32 [B, To, D], see :meth:`condition`.
            scales: see :meth:`condition`.
            mask: bool [K, 3L], valid, of every row.
            chunks: f32 [B, H - To + 1, A], contiguous, to be written.
            reuse: see :meth:`denoise`.
        """
        noise, cond, mask = noise.contiguous(), cond.contiguous(), mask.contiguous()
        rows, _, horizon, dim = noise.shape
        threads, slots = self._num_threads(rows), num_buffers(reuse, self._dense.shape[1])
        actions = torch.empty(rows, horizon, dim, dtype=noise.dtype, device="cpu")
        tensors = (tensor.data_ptr() for tensor in (cond, actions, chunks))
        with self._scratch(packed, threads) as scratch:
            where = self._level, threads, byref(packed.model)
            query = rows, mask.data_ptr(), slots, noise.data_ptr(), byref(scales), *tensors
            loaded().sparse_answer(*where, *query, scratch.data_ptr())

    def _num_threads(self, rows: int) -> int:
        """Return how many threads a batch of ``rows`` uses; more than there are panels in the narrowest product would wait."""
        if self._threads is not None:
            return self._threads
        return min(torch.get_num_threads(), max(rows, -(-self._network.n_emb // PANEL)), MAX_THREADS)

    def refresh(self) -> None:
        """Pack the weights again at the next policy call."""
        self._shared.refresh()

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_seconds`."""
        packed, threads = self._current(), self._num_threads(rows=1)
        scratch = self._new_scratch(packed, threads).zero_()

        def walk(kind: int) -> None:
            loaded().sparse_blocks(self._level, threads, byref(packed.model), kind, scratch.data_ptr())

        return time_blocks(walk, BLOCK_TYPES, self._network.n_layer, repeats, scratch.device)

    def block_macs(self) -> tuple[int, int, int]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_macs`."""
        return folded_block_macs(self._network)

    def overhead_macs(self) -> Overhead:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.overhead_macs`."""
        return folded_overhead_macs(self._network, merged_stem=True)

    @contextmanager
    def _scratch(self, packed: PackedNetwork, threads: int) -> Iterator[Tensor]:
        """Lend memory for one call at a time, from a stock that grows to as many as there are calls at a time."""
        try:
            scratch = self._stock.pop()
        except IndexError:
            scratch = None
        if scratch is None or scratch.numel() < threads * packed.scratch:
            scratch = self._new_scratch(packed, threads)
        yield scratch
        self._stock.append(scratch)

    def _new_scratch(self, packed: PackedNetwork, threads: int) -> Tensor:
        """Allocate on a cache line, as PyTorch always does."""
        return torch.empty(threads * packed.scratch, dtype=torch.float32, device="cpu")

    def _current(self) -> PackedNetwork:
        """Return what the network and the sampler are packed into, again if the network has changed."""
        weights, packed = self._shared.current(), self._packed
        if packed is None or packed.weights is not weights:
            packed = PackedNetwork(self._network, self._sampler, weights)
            # With a slot for each block: enough for every reuse rule.
            packed.scratch = loaded().sparse_scratch(byref(packed.model), self._dense.shape[1])
            self._packed = packed
        return packed

    def _check(self, mask: Tensor | None) -> None:
        if self._network.training:
            raise InputError("network: expected eval mode, got training mode (call network.eval())")
        if mask is not None and not mask.is_cpu:
            raise InputError(f"mask: expected {mask.dtype} on cpu, got {mask.device}")
