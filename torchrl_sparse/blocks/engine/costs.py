"""Actual cost of an engine: seconds and FLOPs of each block type, for planners with a budget, and FLOPs of a policy call."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import Engine, Overhead
from torchrl_sparse.blocks.mask import NetworkSizes, block_macs
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = [
    "BlockCost",
    "engine_block_costs",
    "executed_flops",
    "folded_block_macs",
    "folded_overhead_macs",
]


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
    """Measure the cost of one block of each type in ``engine``: ``"SA"``, ``"FFN"``, and ``"CA"`` where the network has it."""
    seconds, macs = engine.block_seconds(), engine.block_macs()
    return {kind: BlockCost(seconds[kind], 2 * macs[index]) for index, kind in enumerate(seconds)}


def folded_block_macs(network: TransformerForDiffusion) -> tuple[int, int, int]:
    """Count the multiply-accumulates of one SA, CA and FFN block whose cross-attention reads folded memory.

    >>> sizes = dict(input_dim=10, output_dim=10, horizon=10, n_obs_steps=2, cond_dim=19)
    >>> folded_block_macs(TransformerForDiffusion(**sizes, n_layer=1))
    (2672640, 61440, 5242880)
    """
    sizes = NetworkSizes.of(network)
    self_attention, _, feed_forward = block_macs(sizes)
    cross_attention = 2 * sizes.horizon * (1 + sizes.n_obs_steps) * network.n_head * sizes.width
    return self_attention, cross_attention, feed_forward


def folded_overhead_macs(network: TransformerForDiffusion, *, merged_stem: bool) -> Overhead:
    """Count the multiply-accumulates outside the blocks in an engine with folded memory.

    A step embeds the sample and predicts its noise. The condition is encoded and folded once per policy call, or in every step
    if the condition encoder's tokens attend to each other.

    Args:
        network: the denoiser.
        merged_stem: whether the embedding of observations is merged with the first layer of their encoder.

    >>> sizes = dict(input_dim=10, output_dim=10, horizon=10, n_obs_steps=2, cond_dim=19)
    >>> folded_overhead_macs(TransformerForDiffusion(**sizes, n_layer=1), merged_stem=False)
    Overhead(step=51200, memory=0, query=1583104)
    """
    sizes = NetworkSizes.of(network)
    d, tokens = sizes.width, sizes.n_obs_steps
    stem_and_head = (sizes.input_dim + sizes.output_dim) * d * sizes.horizon
    # Keys and values of a token, both multiplied into the other projections, and the bias of its scores.
    fold, embed = sizes.num_layers * (4 * d * d + d), sizes.cond_dim * d
    if not sizes.num_cond_layers:
        encode = 4 * embed + 4 * d * d if merged_stem else embed + 8 * d * d
        return Overhead(stem_and_head, 0, tokens * (encode + fold))
    memory = 1 + tokens
    encode = sizes.num_cond_layers * (12 * d * d * memory + 2 * memory * memory * d)
    return Overhead(stem_and_head + encode, memory * fold, tokens * embed)


def executed_flops(engine: Engine, mask: Tensor, num_steps: Tensor | None = None) -> Tensor:
    """Count the FLOPs (2 * MAC) that ``engine`` executes in policy calls, without norms, softmax, activations and sums.

    :func:`~torchrl_sparse.blocks.mask.query_flops` has the published count, in which cross-attention multiplies its full
    matrices and every step encodes the condition again.

    Args:
        engine: that runs them.
        mask: bool [*B, K, 3L], True = pruned.
        num_steps: i64 [*B, 1], of policy calls that take only the last so many steps and compute all of the first of those.

    Returns:
        f64 [*B], on the CPU.
    """
    mask, last, blocks = mask.cpu(), mask.shape[-2], mask.shape[-1]
    taken = torch.full((*mask.shape[:-2], 1), last) if num_steps is None else num_steps.cpu()
    before = torch.arange(last) - (last - taken)  # steps from the first that is taken, [*B, K]
    computed = (~mask | (before == 0)[..., None]) & (before >= 0)[..., None]
    types = engine.block_macs()
    macs = torch.tensor(types, dtype=torch.float64).repeat(blocks // len(types))
    of_blocks = (computed.double() @ macs).sum(dim=-1)
    outside = engine.overhead_macs()
    reading: Tensor | int = 0
    if outside.memory:  # of cross-attention, which stands in the middle of a layer
        reading = computed[..., 1 :: len(types)].any(dim=-1).sum(dim=-1)
    return 2 * (of_blocks + taken.squeeze(-1) * outside.step + reading * outside.memory + outside.query)
