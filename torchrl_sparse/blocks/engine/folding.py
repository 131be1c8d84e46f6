"""Exact algebra that moves work out of the denoising loop, shared by all engines, in float64.

Each engine lays out, scales and rounds what is returned here as its own loop wants it.

Whatever reads the residual stream begins with a layer norm of gain g and shift s. Both go into the projection that
follows, ``W (g * n + s) + b = (W g) n + (W s + b)``, which then reads what is normalised but neither scaled nor
shifted; 1 / sqrt(head size) goes into the queries.

Cross-attention reads only 1 + To memory tokens, so its big matrices can be multiplied into those tokens before the
loop. With ``q = W_q n + b_q``, ``k_s = W_k m_s + b_k`` and ``v_s = W_v m_s + b_v``, head h scores token s with::

    q_h · k_hs = n · (W_qh' k_hs) + b_qh · k_hs = n · key_hs + bias_hs

and the block adds ``b_o + sum_hs p_hs W_oh v_hs = b_o + sum_hs p_hs value_hs``: what is left inside the loop are two
products with n_head * (1 + To) vectors, instead of two with d x d matrices. The time token of a denoising step depends
on nothing else (without condition layers the condition encoder works token by token), so it is encoded and folded once
per network.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = [
    "Affine",
    "MemoryEncoder",
    "FoldedLayer",
    "FoldedMemory",
    "after_norm",
    "fold_layers",
    "fold_observation_stem",
    "fold_tokens",
]


class Affine(NamedTuple):
    """A linear layer, f64: ``weight`` [*out, *in] and ``bias`` [*out]."""

    weight: Tensor
    bias: Tensor


class FoldedLayer(NamedTuple):
    """A decoder layer; ``qkv``, ``up`` and ``query`` read normalised input without gain and shift.

    Attributes:
        qkv: of self-attention, weight [3, n_head, head size, d].
        out: of self-attention, weight [d, n_head, head size].
        up, down: of the feed-forward network.
        query: of cross-attention, weight [n_head, head size, d].
        key_value: of cross-attention, from memory tokens, weight [2, n_head, head size, d].
        cross_out: of cross-attention, weight [d, n_head, head size].
    """

    qkv: Affine
    out: Affine
    up: Affine
    down: Affine
    query: Affine
    key_value: Affine
    cross_out: Affine


class FoldedMemory(NamedTuple):
    """N memory tokens, folded into the cross-attention of all L layers.

    Attributes:
        vectors: [L, 2, N, n_head, d]; entry 0 of axis 1 holds the keys, entry 1 the values.
        bias: [L, N, n_head], added to the scores.
    """

    vectors: Tensor
    bias: Tensor


def after_norm(norm: nn.LayerNorm, layer: Affine) -> Affine:
    """Fold gain and shift of ``norm`` into the ``layer`` that follows it, weight [out, d].

    >>> norm, x = nn.LayerNorm(2), torch.tensor([3.0, 1.0], dtype=torch.float64)
    >>> _ = norm.weight.data.fill_(2.0), norm.bias.data.fill_(1.0)
    >>> after_norm(norm, Affine(torch.eye(2), torch.zeros(2)))
    Affine(weight=tensor([[2., 0.],
            [0., 2.]], dtype=torch.float64), bias=tensor([1., 1.], dtype=torch.float64))
    """
    weight, bias = (part.detach().double() for part in layer)
    gain, shift = norm.weight.detach().double(), norm.bias.detach().double()
    return Affine(weight * gain, bias + weight @ shift)


def fold_layers(network: TransformerForDiffusion) -> list[FoldedLayer]:
    """Fold norms and scales of every decoder layer into its projections."""
    return [_fold_layer(layer, network.n_head) for layer in network.decoder.layers]


def _fold_layer(layer: nn.TransformerDecoderLayer, heads: int) -> FoldedLayer:
    attention, cross, width = layer.self_attn, layer.multihead_attn, layer.self_attn.embed_dim
    scale = (width // heads) ** -0.5
    qkv = _split(after_norm(layer.norm1, _in_proj(attention)), (3, heads, -1))
    for part in qkv:
        part[0] *= scale
    cross_in = _in_proj(cross)
    query = after_norm(layer.norm2, Affine(*(part[:width] for part in cross_in)))
    return FoldedLayer(
        qkv=qkv,
        out=_by_head(attention.out_proj, heads),
        up=after_norm(layer.norm3, _exact(layer.linear1)),
        down=_exact(layer.linear2),
        query=Affine(*(part * scale for part in _split(query, (heads, -1)))),
        key_value=_split(Affine(*(part[width:] for part in cross_in)), (2, heads, -1)),
        cross_out=_by_head(cross.out_proj, heads),
    )


def fold_tokens(layers: Sequence[FoldedLayer], tokens: Tensor) -> FoldedMemory:
    """Fold encoded memory ``tokens``, f64 [N, d], into the cross-attention of all layers."""
    folded = [_fold_into(layer, tokens) for layer in layers]
    return FoldedMemory(*map(torch.stack, zip(*folded, strict=True)))


def _fold_into(layer: FoldedLayer, tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Return keys and values [2, N, n_head, d], and score biases [N, n_head]."""
    heads = layer.query.bias.shape
    weight, bias = (part.flatten(1, 2) for part in layer.key_value)
    key, value = (torch.einsum("nod,kd->nko", weight, tokens) + bias[:, None]).unflatten(2, heads)
    keys = torch.einsum("khc,hcd->khd", key, layer.query.weight)
    values = torch.einsum("khc,dhc->khd", value, layer.cross_out.weight)
    return torch.stack([keys, values]), torch.einsum("khc,hc->kh", key, layer.query.bias)


def fold_observation_stem(network: TransformerForDiffusion) -> Affine:
    """Merge the observation embedding with the first encoder layer: bias [To, 4d], since tokens have positions.

    Only for a condition encoder that works token by token.
    """
    embed, up = network.cond_obs_emb, _exact(network.encoder[0])
    bias = (embed.bias.detach().double() + network.cond_pos_emb.detach()[0, 1:]) @ up.weight.T + up.bias
    return Affine(up.weight @ embed.weight.detach().double(), bias)


class MemoryEncoder:
    """Encoder of the memory tokens of all denoising steps, each encoded once; a snapshot of the network's weights.

    Args:
        network: the denoiser.
        timesteps: i64 [K], the diffusion timestep of each denoising step.
        dtype: to compute in; the network's own by default.

    Attributes:
        separable: the encoder works token by token, so that time and observations may be encoded apart.
    """

    def __init__(
        self, network: TransformerForDiffusion, timesteps: Tensor, dtype: torch.dtype | None = None
    ) -> None:
        self.separable = network.n_cond_layers == 0
        self._encoder: nn.Module = copy.deepcopy(network.encoder).eval().to(dtype=dtype)
        self._embed: nn.Module = copy.deepcopy(network.cond_obs_emb).to(dtype=dtype)
        self._position = network.cond_pos_emb.detach().clone().to(dtype=dtype)
        position = self._position[0, :1]
        time = network.time_emb(timesteps.to(position.device)).to(position.dtype)
        self._time = time + position

    def time_tokens(self) -> Tensor:
        """Encode the time tokens [K, d]; the encoder must be separable."""
        return self._encoder(self._time)

    def observation_tokens(self, cond: Tensor) -> Tensor:
        """Encode the observation tokens [B, To, d] of ``cond`` [B, To, cond_dim]; the encoder must be separable."""
        return self._encoder(self._observations(cond))

    def memory(self, cond: Tensor) -> Tensor:
        """Encode all tokens [K, B, 1 + To, d] with any encoder, as one batch of K * B."""
        steps, batch = len(self._time), len(cond)
        time = self._time[:, None, None].expand(-1, batch, -1, -1)
        tokens = torch.cat([time, self._observations(cond).expand(steps, -1, -1, -1)], dim=2)
        return self._encoder(tokens.flatten(0, 1)).unflatten(0, (steps, batch))

    def _observations(self, cond: Tensor) -> Tensor:
        return self._embed(cond) + self._position[:, 1:]


def _exact(layer: nn.Linear) -> Affine:
    return Affine(layer.weight.detach().double(), layer.bias.detach().double())


def _in_proj(attention: nn.MultiheadAttention) -> Affine:
    return Affine(attention.in_proj_weight.detach().double(), attention.in_proj_bias.detach().double())


def _split(layer: Affine, sizes: tuple[int, ...]) -> Affine:
    """Split the outputs of ``layer`` into ``sizes``."""
    return Affine(*(part.unflatten(0, sizes) for part in layer))


def _by_head(layer: nn.Linear, heads: int) -> Affine:
    """Split the inputs of ``layer`` by head."""
    weight, bias = _exact(layer)
    return Affine(weight.unflatten(1, (heads, -1)), bias)
