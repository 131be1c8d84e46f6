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
from torchrl_sparse.blocks.engine.linear import make_linear, transposed
from torchrl_sparse.blocks.engine.plan import slot_counts
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["CrossAttention", "FeedForward", "SelfAttention", "Tables"]

_SHARED_BUFFERS = tuple(num_buffers(reuse, num_blocks=0) for reuse in ("type", "single"))


def _make_norm(norm: nn.LayerNorm) -> Callable[[Tensor], Tensor]:
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
        self._norm = _make_norm(layer.norm1)
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
        self._norm = _make_norm(layer.norm2)
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
        self._norm = _make_norm(layer.norm3)
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
        self.cond_shape = (network.n_obs_steps, network.cond_dim)
        self.num_layers, self.num_blocks, self.num_heads = network.n_layer, network.num_blocks, network.n_head
        kinds = (SelfAttention, CrossAttention, FeedForward)
        self.blocks = [kinds[b % 3](network, b // 3) for b in range(network.num_blocks)]
        self.norm = _make_norm(network.ln_f)
        self.stem_weight = transposed(network.input_emb.weight)
        self.stem_bias = network.input_emb.bias + network.pos_emb[0]
        self.head_weight = transposed(network.head.weight)
        self.head_bias = network.head.bias.clone()
        self.memory_mask = None if network.memory_mask is None else network.memory_mask.clone()
        self.fold = CrossAttentionFold(network)
        self.encoder = ConditionEncoder(network, schedule.timesteps)
        self.time = self.fold(self.encoder.time_tokens()) if self.encoder.separable else None
        coefficients = step_coefficients(schedule)
        self.clip, self.spread = coefficients.clip, coefficients.spread.to(self.stem_weight)
        rows = zip(*coefficients.columns(), strict=True)
        # A division by a Python number would first make a tensor of it, in every step.
        self.updates = [(a, torch.tensor(b).to(self.spread), c, d, e) for a, b, c, d, e in rows]
        self.counts = {n: _count_table(self.num_blocks, n, self.stem_weight) for n in _SHARED_BUFFERS}


def _count_table(num_blocks: int, num_slots: int, like: Tensor) -> list[list[Tensor]]:
    """``table[first][last]``: how often the blocks ``first .. last-1`` read each shared buffer, [num_slots]."""
    edges = range(num_blocks + 1)
    counts = [[slot_counts(first, max(first, last), num_slots) for last in edges] for first in edges]
    return [list(row.unbind(0)) for row in torch.tensor(counts).to(like).unbind(0)]
