"""The three blocks as the PyTorch engine runs them: few large operations on prepared weights, no gradients.

Tokens of a batch are rows, [B * H, d]; every block returns what it adds to them.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sparse.blocks.engine.coefficients import step_coefficients
from torchrl_sparse.blocks.engine.folding import ConditionEncoder, CrossAttentionFold
from torchrl_sparse.blocks.engine.plan import type_counts
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["CrossAttention", "FeedForward", "SelfAttention", "Tables", "can_pack", "make_linear", "make_norm"]


def make_linear(weight: Tensor, bias: Tensor, gelu: bool = False) -> Callable[[Tensor], Tensor]:
    """``x [N, in] -> [N, out]``, with GELU behind it if asked for.

    Ten rows leave PyTorch's general matrix product at a half of the speed that the weights could be read with. oneDNN's product
    on weights that were laid out for it in advance (what Inductor emits for a CPU) gets closer.
    """
    weight, bias = weight.detach(), bias.detach().clone()
    if can_pack(weight):
        packed = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous())
        product = torch.ops.mkldnn._linear_pointwise.default
        activation, algorithm = ("gelu", "none") if gelu else ("none", "")
        return lambda x: product(x, packed, bias, activation, [], algorithm)
    transposed = _transposed(weight)
    if gelu:
        return lambda x: F.gelu(torch.addmm(bias, x, transposed))
    return lambda x: torch.addmm(bias, x, transposed)


def can_pack(weight: Tensor) -> bool:
    """Whether a product with ``weight`` can run on oneDNN's own layout: float32, on a CPU, in a build with oneDNN."""
    available = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")
    return available and weight.device.type == "cpu" and weight.dtype == torch.float32


def _transposed(weight: Tensor) -> Tensor:
    return weight.t().clone(memory_format=torch.contiguous_format)


def make_norm(norm: nn.LayerNorm) -> Callable[[Tensor], Tensor]:
    """The layer norm ``norm`` as a function, without a module around it."""
    shape, eps = norm.normalized_shape, norm.eps
    weight, bias = norm.weight.detach().clone(), norm.bias.detach().clone()
    return lambda x: torch.layer_norm(x, shape, weight, bias, eps)


class SelfAttention:
    """SA: ``W_o attention(W_qkv LN(x))``.

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        layer = network.decoder.layers[index]
        attention = layer.self_attn
        self._norm = make_norm(layer.norm1)
        self._project = make_linear(attention.in_proj_weight, attention.in_proj_bias)
        self._output = make_linear(attention.out_proj.weight, attention.out_proj.bias)
        self._shape = (-1, network.horizon, 3, network.n_head, network.n_emb // network.n_head)
        self._causal = network.causal_attn

    def __call__(self, x: Tensor) -> Tensor:
        """What the block adds to ``x`` [N * H, d]."""
        query, key, value = self._project(self._norm(x)).view(self._shape).permute(2, 0, 3, 1, 4).unbind(0)
        mixed = F.scaled_dot_product_attention(query, key, value, is_causal=self._causal)
        return self._output(mixed.transpose(1, 2).reshape(x.shape))


class CrossAttention:
    """CA on folded memory (:mod:`torchrl_sparse.blocks.engine.folding`).

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        layer = network.decoder.layers[index]
        self._norm = make_norm(layer.norm2)
        self._bias = layer.multihead_attn.out_proj.bias.detach().clone()
        self._tokens = (network.horizon, network.n_emb)
        self._scores = (network.horizon, 1 + network.n_obs_steps, network.n_head)

    def __call__(self, x: Tensor, keys: Tensor, values: Tensor, bias: Tensor) -> Tensor:
        """What the block adds to ``x`` [N * H, d].

        Args:
            x: residual stream.
            keys: [N, (1 + To) * n_head, d].
            values: the same shape.
            bias: [N, H, (1 + To) * n_head], with -inf where a token is hidden.
        """
        normed = self._norm(x).view(-1, *self._tokens)
        scores = torch.baddbmm(bias, normed, keys.mT)
        weights = torch.softmax(scores.view(-1, *self._scores), dim=2).view(scores.shape)
        return torch.baddbmm(self._bias, weights, values).view(x.shape)


class FeedForward:
    """FFN: ``W_2 gelu(W_1 LN(x))``.

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        layer = network.decoder.layers[index]
        self._norm = make_norm(layer.norm3)
        self._inner = make_linear(layer.linear1.weight, layer.linear1.bias, gelu=True)
        self._outer = make_linear(layer.linear2.weight, layer.linear2.bias)

    def __call__(self, x: Tensor) -> Tensor:
        """What the block adds to ``x`` [N * H, d]."""
        return self._outer(self._inner(self._norm(x)))


class Tables:
    """All that the engine knows before it sees an observation; a snapshot of the network's weights.

    Args:
        network: the denoiser.
        schedule: the sampler.
    """

    def __init__(self, network: TransformerForDiffusion, schedule: NoiseSchedule) -> None:
        self.device = network.pos_emb.device
        self.horizon, self.width = network.horizon, network.n_emb
        self.num_layers, self.num_blocks, self.num_heads = network.n_layer, network.num_blocks, network.n_head
        kinds = (SelfAttention, CrossAttention, FeedForward)
        self.blocks = [kinds[b % 3](network, b // 3) for b in range(network.num_blocks)]
        self.norm = make_norm(network.ln_f)
        self.stem_weight = _transposed(network.input_emb.weight)
        self.stem_bias = network.input_emb.bias + network.pos_emb[0]
        self.head_weight = _transposed(network.head.weight)
        self.head_bias = network.head.bias.clone()
        self.memory_mask = None if network.memory_mask is None else network.memory_mask.clone()
        self.fold = CrossAttentionFold(network)
        self.encoder = ConditionEncoder(network, schedule.timesteps)
        self.time = self.fold(self.encoder.time_tokens()) if self.encoder.separable else None
        coefficients = step_coefficients(schedule)
        self.clip, self.spread = coefficients.clip, coefficients.spread.to(self.stem_weight)
        self.updates = coefficients.rows()
        self.counts = _count_table(self.num_blocks, self.stem_weight)


def _count_table(num_blocks: int, like: Tensor) -> list[list[Tensor]]:
    """``table[first][last]``: how many SA, CA and FFN blocks there are among ``first .. last-1``, [3]."""
    edges = range(num_blocks + 1)
    counts = [[type_counts(first, max(first, last)) for last in edges] for first in edges]
    return [list(row.unbind(0)) for row in torch.tensor(counts).to(like).unbind(0)]
