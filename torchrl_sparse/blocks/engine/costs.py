"""The cost of one block in an engine, in seconds and in FLOPs: for planners that budget in time."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_sparse.blocks.engine.base import Engine
from torchrl_sparse.blocks.mask import BLOCK_TYPES, NetworkSizes, block_macs
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["BlockCost", "engine_block_costs", "folded_block_macs"]


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


def engine_block_costs(engine: Engine) -> dict[str, BlockCost]:
    """Measure the cost of one ``"SA"``, ``"CA"`` and ``"FFN"`` block in ``engine``."""
    seconds, macs = engine.block_seconds(), engine.block_macs()
    return {kind: BlockCost(seconds[kind], 2 * macs[index]) for index, kind in enumerate(BLOCK_TYPES)}


def folded_block_macs(network: TransformerForDiffusion) -> tuple[int, int, int]:
    """Count the multiply-accumulates of one SA, CA and FFN block where cross-attention reads folded memory.

    >>> sizes = dict(input_dim=10, output_dim=10, horizon=10, n_obs_steps=2, cond_dim=19)
    >>> folded_block_macs(TransformerForDiffusion(**sizes, n_layer=1))
    (2672640, 61440, 5242880)
    """
    sizes = NetworkSizes.of(network)
    self_attention, _, feed_forward = block_macs(sizes)
    cross_attention = 2 * sizes.horizon * (1 + sizes.n_obs_steps) * network.n_head * sizes.width
    return self_attention, cross_attention, feed_forward
