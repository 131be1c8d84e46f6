"""Exact algebra that takes work out of the denoising loop.

Cross-attention reads only 1 + To memory tokens, so its big matrices can be multiplied into those tokens
before the loop. With ``q = W_q x + b_q``, ``k_s = W_k m_s + b_k`` and ``v_s = W_v m_s + b_v``, head h scores
token s with::

    q_h · k_hs / sqrt(d_h) = x · (W_qh' k_hs) / sqrt(d_h) + b_qh · k_hs / sqrt(d_h) = x · key_hs + bias_hs

and the block adds ``b_o + sum_hs p_hs W_oh v_hs = b_o + sum_hs p_hs value_hs``: what is left inside the loop
are two products with n_head * (1 + To) vectors, instead of two with d x d matrices. The time token of a
denoising step depends on nothing else (without condition layers the condition encoder works token by token),
so it is encoded and folded once per network.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_sparse.blocks.engine.linear import make_linear
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["ConditionEncoder", "CrossAttentionFold", "FoldedMemory"]


@dataclass(frozen=True)
class FoldedMemory:
    """What N memory tokens mean to the cross-attention of all L layers.

    Attributes:
        vectors: [L, 2, N, n_head, d]; entry 0 of axis 1 holds the keys, entry 1 the values.
        bias: [L, N, n_head], added to the scores.
    """

    vectors: Tensor
    bias: Tensor


class CrossAttentionFold:
    """Folds memory tokens into keys and values of width d; a snapshot of the network's weights.

    Args:
        network: the denoiser.

    Examples:
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=3, n_head=2, n_emb=16
        ... )
        >>> CrossAttentionFold(network)(torch.zeros(6, 16)).vectors.shape
        torch.Size([3, 2, 6, 2, 16])
    """

    def __init__(self, network: TransformerForDiffusion) -> None:
        heads, width = network.n_head, network.n_emb
        size = width // heads
        attention = [layer.multihead_attn for layer in network.decoder.layers]
        weight = torch.stack([a.in_proj_weight for a in attention]).detach()
        bias = torch.stack([a.in_proj_bias for a in attention]).detach()
        output = torch.stack([a.out_proj.weight for a in attention]).detach()
        by_head = (len(attention), heads, size, width)
        # Scores are scaled by 1 / sqrt(d_h); scaling the query side scales keys and biases alike.
        self._query = (weight[:, :width] * size**-0.5).reshape(by_head)
        self._query_bias = (bias[:, :width] * size**-0.5).reshape(*by_head[:3], 1)
        self._project = make_linear(weight[:, width:].flatten(0, 1), bias[:, width:].flatten())
        self._output = output.reshape(len(attention), width, heads, size).permute(0, 2, 3, 1).contiguous()

    def __call__(self, tokens: Tensor) -> FoldedMemory:
        """Fold encoded memory ``tokens`` [N, d]."""
        layers, heads, size, _ = self._query.shape
        projected = self._project(tokens).view(-1, layers, 2, heads, size)
        key, value = projected.permute(2, 1, 3, 0, 4)  # [L, n_head, N, d_h] each
        vectors = torch.stack([key @ self._query, value @ self._output], dim=1)
        return FoldedMemory(vectors.transpose(2, 3), (key @ self._query_bias).squeeze(-1).transpose(1, 2))


class ConditionEncoder:
    """Memory tokens of all denoising steps, each encoded once; a snapshot of the network's weights.

    Args:
        network: the denoiser.
        timesteps: i64 [K], the diffusion timestep of each denoising step.

    Attributes:
        separable: the encoder works token by token, so that time and observations may be encoded apart.
    """

    def __init__(self, network: TransformerForDiffusion, timesteps: Tensor) -> None:
        self.separable = network.n_cond_layers == 0
        self._encoder: nn.Module = copy.deepcopy(network.encoder).eval()
        self._embed: nn.Module = copy.deepcopy(network.cond_obs_emb)
        self._position = network.cond_pos_emb.detach().clone()
        position = self._position[0, :1]
        time = network.time_emb(timesteps.to(position.device)).to(position.dtype)
        self._time = time + position

    def time_tokens(self) -> Tensor:
        """The encoded time tokens [K, d] of a separable encoder."""
        return self._encoder(self._time)

    def observation_tokens(self, cond: Tensor) -> Tensor:
        """The encoded observation tokens [B, To, d] of a separable encoder; ``cond`` is [B, To, cond_dim]."""
        return self._encoder(self._observations(cond))

    def memory(self, cond: Tensor) -> Tensor:
        """All tokens [K, B, 1 + To, d], of any encoder: one batch of K * B."""
        steps, batch = len(self._time), len(cond)
        time = self._time[:, None, None].expand(-1, batch, -1, -1)
        tokens = torch.cat([time, self._observations(cond).expand(steps, -1, -1, -1)], dim=2)
        return self._encoder(tokens.flatten(0, 1)).unflatten(0, (steps, batch))

    def _observations(self, cond: Tensor) -> Tensor:
        return self._embed(cond) + self._position[:, 1:]
