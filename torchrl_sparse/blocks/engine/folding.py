"""Exact algebra that takes work out of the denoising loop.

Cross-attention reads only 1 + To memory tokens, so its big matrices can be multiplied into those tokens
before the loop. With ``q = W_q x + b_q``, ``k_s = W_k m_s + b_k`` and ``v_s = W_v m_s + b_v``, head h scores
token s with::

    q_h · k_hs / sqrt(d_h) = x · (W_qh' k_hs) / sqrt(d_h) + b_qh · k_hs / sqrt(d_h) = x · key_hs + bias_hs

and the block adds ``b_o + sum_hs p_hs W_oh v_hs = b_o + sum_hs p_hs value_hs``: what is left inside the loop
are two products with n_head * (1 + To) vectors, instead of two with d x d matrices. The time token of a
denoising step depends on nothing else (without condition layers the condition encoder works token by token),
so it is encoded and folded once per network.

Whatever reads the residual stream begins with a layer norm, ``g (x - mean) / sqrt(var + eps) + s``. Gain and
shift go into the weights that follow. As nothing ever sees the mean of the stream, what is added to it is
centred beforehand, in the weights that make it; all that is left of a norm is a division by a length,
``x / sqrt(|x|^2 + d eps)``, and a factor sqrt(d) that goes into the weights as well.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = [
    "ConditionEncoder",
    "CrossAttentionFold",
    "FoldRoom",
    "FoldedMemory",
    "after_length",
    "after_norm",
    "centred",
]


def after_norm(norm: nn.LayerNorm, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """f64 weight [out, d] and bias [out] of the layer behind ``norm``, to be used on what is normalised but not
    yet scaled and shifted."""
    weight, gain, shift = (part.detach().double() for part in (weight, norm.weight, norm.bias))
    return weight * gain, bias.detach().double() + weight @ shift


def after_length(norm: nn.LayerNorm, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """The same, in the type of ``weight``, to be used on ``x / sqrt(|x|^2 + d eps)`` of a centred x.

    >>> norm, x = nn.LayerNorm(4), torch.tensor([1.0, -3.0, 0.0, 2.0])
    >>> weight, bias = after_length(norm, torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.ones(1))
    >>> torch.allclose(weight @ (x / (x @ x + 4 * norm.eps).sqrt()) + bias, norm(x) @ torch.arange(1.0, 5) + 1)
    True
    """
    folded, shifted = after_norm(norm, weight, bias)
    return (folded * weight.shape[-1] ** 0.5).to(weight), shifted.to(weight)


def centred(tensor: Tensor) -> Tensor:
    """``tensor`` [..., d] without its mean over d.

    >>> centred(torch.tensor([1.0, 2.0, 6.0]))
    tensor([-2., -1.,  3.])
    """
    exact = tensor.detach().double()
    return (exact - exact.mean(dim=-1, keepdim=True)).to(tensor)


@dataclass(frozen=True)
class FoldedMemory:
    """What N memory tokens mean to the cross-attention of all L layers.

    Attributes:
        vectors: [L, 2, N, n_head, d]; entry 0 of axis 1 holds the keys, entry 1 the values.
        bias: [L, N, n_head], added to the scores.
    """

    vectors: Tensor
    bias: Tensor


class FoldRoom:
    """The memory that folding N tokens takes, and its result; made by :meth:`CrossAttentionFold.room`.

    Args:
        num_tokens: N.
        sizes: layers L, heads, head size, width d.
        like: gives type and device.

    Attributes:
        folded: of the tokens that were folded last.
    """

    def __init__(self, num_tokens: int, sizes: tuple[int, int, int, int], like: Tensor) -> None:
        layers, heads, size, width = sizes
        self.projected = like.new_empty(num_tokens, layers * 2 * heads * size)
        self.projected_by_token = (num_tokens, layers, 2, heads, size)
        self.split = like.new_empty(2, layers, heads, num_tokens, size)
        self.key, self.value = self.split.flatten(1, 2).unbind(0)
        vectors = like.new_empty(2, layers, heads, num_tokens, width)
        self.key_vectors, self.value_vectors = vectors.flatten(1, 2).unbind(0)
        bias = like.new_empty(layers, heads, num_tokens)
        self.bias = bias.view(layers * heads, num_tokens, 1)
        self.folded = FoldedMemory(vectors.permute(1, 0, 3, 2, 4), bias.transpose(1, 2))


class CrossAttentionFold:
    """Folds memory tokens into keys and values of width d; a snapshot of the network's weights.

    The keys are for activations divided by their length, the values are centred.

    Args:
        network: the denoiser.

    Examples:
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=3, n_head=2, n_emb=16
        ... )
        >>> fold = CrossAttentionFold(network)
        >>> fold(torch.zeros(6, 16), fold.room(6)).vectors.shape
        torch.Size([3, 2, 6, 2, 16])
    """

    def __init__(self, network: TransformerForDiffusion) -> None:
        heads, width = network.n_head, network.n_emb
        layers, size = network.decoder.layers, width // heads
        attention = [layer.multihead_attn for layer in layers]
        weight = torch.stack([a.in_proj_weight for a in attention]).detach()
        bias = torch.stack([a.in_proj_bias for a in attention]).detach()
        output = torch.stack([a.out_proj.weight.T for a in attention])
        # Scores are scaled by 1 / sqrt(d_h); scaling the query side scales keys and biases alike.
        queries = [
            after_length(layer.norm2, weight[i, :width] * size**-0.5, bias[i, :width] * size**-0.5)
            for i, layer in enumerate(layers)
        ]
        self._sizes = (len(layers), heads, size, width)
        self._query = torch.stack([query for query, _ in queries]).view(-1, size, width)
        self._query_bias = torch.stack([shift for _, shift in queries]).view(-1, size, 1)
        self._project = make_linear(weight[:, width:].flatten(0, 1), bias[:, width:].flatten())
        self._output = centred(output).view(-1, size, width)

    def room(self, num_tokens: int) -> FoldRoom:
        """Memory to fold ``num_tokens`` tokens in."""
        return FoldRoom(num_tokens, self._sizes, self._query)

    def __call__(self, tokens: Tensor, room: FoldRoom) -> FoldedMemory:
        """Fold encoded memory ``tokens`` [N, d]; the result is that of ``room``, until it is used again."""
        projected = self._project(tokens, room.projected).view(room.projected_by_token)
        room.split.copy_(projected.permute(2, 1, 3, 0, 4))
        torch.bmm(room.key, self._query, out=room.key_vectors)
        torch.bmm(room.value, self._output, out=room.value_vectors)
        torch.bmm(room.key, self._query_bias, out=room.bias)
        return room.folded


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
