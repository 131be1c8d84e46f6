"""FLOPs of a vision-language-action model from its sizes: 2 * MAC of all matrix products.

Counted are linear layers, patch embeddings and both products of attention (each of the S tokens with each, since nothing is
causal); not counted are norms, activations, softmax, additions and the lookup of embeddings. The decoder has no vocabulary
projection, as its read-outs go to the action head. With S tokens a layer of width d and feed-forward width m is::

    2 * S * (4 * d**2 + 3 * d * m) + 4 * d * S**2

where keys and values that heads share make two of the four d**2 narrower. For the published 7B decoder at S = 605 that is
8.03e12 in 32 layers: 7.84e12 linear, 0.19e12 attention.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig

__all__ = ["decoder_flops", "fixed_flops", "query_flops", "score_flops"]


def decoder_flops(config: VLAConfig, tokens: Tensor) -> Tensor:
    """Return the FLOPs [...] of the decoder, f64.

    Args:
        config: sizes.
        tokens: [..., L], how many tokens each layer ran on; 0 where it was skipped.

    Examples:
        >>> dense = decoder_flops(VLAConfig(), torch.full((32,), 605))
        >>> round(dense.item() / 1e12, 2)
        8.03
    """
    size, tokens = config.llm, tokens.double()
    linear = 2 * size.dim * (2 * size.dim + 2 * config.kv_dim + 3 * size.mlp)
    return (tokens * linear + 4 * size.dim * tokens**2).sum(-1)


def score_flops(config: VLAConfig, pairs: Tensor) -> Tensor:
    """Return the FLOPs of scoring ``pairs`` (row, token) pairs, summed over all scored layers."""
    return 2.0 * config.llm.dim * pairs.double()


def fixed_flops(config: VLAConfig) -> dict[str, float]:
    """Return the FLOPs that token pruning does not change, by component.

    Examples:
        >>> {name: round(value / 1e12, 3) for name, value in fixed_flops(VLAConfig()).items()}
        {'dino': 0.316, 'siglip': 0.422, 'projector': 0.073, 'proprio': 0.0, 'head': 0.002}
    """
    patches, images = config.visual_spec.per_camera, len(config.cameras)
    features, width = config.dino.dim + config.siglip.dim, config.llm.dim
    per_patch = 4 * features**2 + 4 * features * width + width**2
    per_action = config.action_dim * width**2 + 2 * width**2 + width * config.action_dim
    return {
        "dino": images * _tower_flops(config, config.dino, patches + 1 + config.registers),
        "siglip": images * _tower_flops(config, config.siglip, patches),
        "projector": 2.0 * images * patches * per_patch,
        "proprio": 2.0 * (config.state_dim * width + width**2),
        "head": 2.0 * config.chunk_size * per_action,
    }


def query_flops(config: VLAConfig, tokens: Tensor, scored: Tensor) -> Tensor:
    """Return the FLOPs f32 [B] of whole policy calls, including the attention scores that hooks request.

    Args:
        config: sizes.
        tokens: i64 [B, L], tokens on which each decoder layer ran.
        scored: i64 [B], (row, token) pairs that were scored.
    """
    fixed = sum(fixed_flops(config).values())
    return (fixed + decoder_flops(config, tokens) + score_flops(config, scored)).to(torch.float32)


def _tower_flops(config: VLAConfig, size: TransformerSize, tokens: int) -> float:
    layer = 2 * tokens * (4 * size.dim**2 + 2 * size.dim * size.mlp) + 4 * size.dim * tokens**2
    patches = 2 * config.visual_spec.per_camera * 3 * config.patch_size**2 * size.dim
    return float((size.layers - 1) * layer + patches)
