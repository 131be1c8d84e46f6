"""What one block costs in an engine, in seconds and in FLOPs: for planners that budget in time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from torchrl_sparse.blocks.mask import BLOCK_TYPES, NetworkSizes, block_macs

if TYPE_CHECKING:
    from torchrl_sparse.blocks.engine.base import Engine
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["BlockCost", "engine_block_costs", "folded_block_macs", "time_blocks"]


@dataclass(frozen=True)
class BlockCost:
    """Cost of one evaluation of a block, batch 1.

    Attributes:
        seconds: measured.
        flops: 2 * multiply-accumulates that the engine really does;
            :func:`~torchrl_sparse.blocks.mask.block_macs` has the published count, in which cross-attention
            multiplies its full matrices.
    """

    seconds: float
    flops: int


def engine_block_costs(engine: Engine, network: TransformerForDiffusion) -> dict[str, BlockCost]:
    """Cost of one ``"SA"``, ``"CA"`` and ``"FFN"`` block of ``network`` in ``engine``, measured now."""
    sizes = NetworkSizes.of(network)
    macs = block_macs(sizes) if engine.name == "reference" else folded_block_macs(sizes, network.n_head)
    seconds = engine.block_seconds()
    return {kind: BlockCost(seconds[kind], 2 * macs[index]) for index, kind in enumerate(BLOCK_TYPES)}


def folded_block_macs(sizes: NetworkSizes, num_heads: int) -> tuple[int, int, int]:
    """Multiply-accumulates of one SA, CA and FFN block where cross-attention reads folded memory.

    >>> lift = NetworkSizes(8, horizon=10, n_obs_steps=2, width=256, input_dim=10, output_dim=10, cond_dim=19)
    >>> folded_block_macs(lift, num_heads=4)
    (2672640, 61440, 5242880)
    """
    self_attention, _, feed_forward = block_macs(sizes)
    cross_attention = 2 * sizes.horizon * (1 + sizes.n_obs_steps) * num_heads * sizes.width
    return self_attention, cross_attention, feed_forward


def time_blocks(
    walk: Callable[[int], None], num_layers: int, repeats: int, device: torch.device
) -> dict[str, float]:
    """Seconds of a block of each type: the best of ``repeats``, which other work on the machine disturbs
    least.

    Args:
        walk: runs the blocks of one type (0 SA, 1 CA, 2 FFN) of all layers, so that weights come from where
            they come from in a query.
        num_layers: layers L.
        repeats: timed walks of each type, interleaved, after a few that are not timed.
        device: synchronised around every walk if it is a GPU.
    """
    samples: list[list[float]] = [[] for _ in BLOCK_TYPES]
    for turn in range(-3, repeats):
        for kind in range(len(BLOCK_TYPES)):
            seconds = _time_once(walk, kind, device) / num_layers
            if turn >= 0:
                samples[kind].append(seconds)
    return {name: min(samples[kind]) for kind, name in enumerate(BLOCK_TYPES)}


def _time_once(walk: Callable[[int], None], kind: int, device: torch.device) -> float:
    _synchronize(device)
    start = time.perf_counter()
    walk(kind)
    _synchronize(device)
    return time.perf_counter() - start


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
