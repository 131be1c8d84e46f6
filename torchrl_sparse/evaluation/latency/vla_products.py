"""Matrix products of a decoder alone, beside a large one, to tell whether policy calls reach the machine's arithmetic limit.

The products are those of a dense call, layer after layer on each layer's own weights, so that memory traffic equals a call's.
The large one, square, is what the machine does at best: by oneDNN where PyTorch has it, see
`torchrl_sparse.evaluation.latency.limits.measure_multiply_adds`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.evaluation.latency.vla_cases import VLACase

__all__ = ["ProductCall", "product_calls"]

_SIDE = 2048


@dataclass(frozen=True)
class ProductCall:
    """Matrix products to time: the call, and its FLOPs, 2 * MAC."""

    call: Callable[[], Any]
    flops: float


def product_calls(case: VLACase) -> dict[str, ProductCall]:
    """Return the decoder's linear layers, its attention, and the large product: name -> call."""
    sequence, config = case.sequence().hidden, case.network.config
    layers, length = case.network.decoder.llama.layers, sequence.shape[1]
    inputs = {width: sequence.new_ones(1, length, width) for width in (config.llm.dim, config.llm.mlp)}
    linear = [(part, inputs[part.in_features]) for part in layers.modules() if isinstance(part, nn.Linear)]
    heads = torch.randn_like(sequence).unflatten(-1, (config.llm.heads, -1)).transpose(1, 2)
    square, out = (sequence.new_ones(_SIDE, _SIDE) for _ in range(2))
    multiply = make_linear(square, square[0])

    def attend() -> None:
        for _ in layers:
            functional.scaled_dot_product_attention(heads, heads, heads)

    return {
        "linear layers": ProductCall(
            lambda: [part(x) for part, x in linear],
            2.0 * length * sum(part.weight.numel() for part, _ in linear),
        ),
        "attention": ProductCall(attend, 4.0 * len(layers) * config.llm.dim * length**2),
        "large square": ProductCall(lambda: multiply(square, out), 2.0 * _SIDE**3),
    }
