"""The denoising transformer of Diffusion Policy (arXiv:2303.04137, "DP-T"), with its blocks callable one by one.

The network predicts the noise of an action chunk from the noisy chunk, the diffusion timestep and the last
observations. Its trunk is a pre-norm decoder; every layer holds three *blocks*, in this order::

    x = x + SA(LN1(x))              self-attention over the chunk (causal)
    x = x + CA(LN2(x), memory)      cross-attention to [timestep, observations]
    x = x + FFN(LN3(x))             feed-forward, hidden size 4 * n_emb

Block ``3 * layer + {0: SA, 1: CA, 2: FFN}`` is the unit that caching methods skip, so the forward pass is a loop over
:meth:`TransformerForDiffusion.block`. Parameter names equal those of the published checkpoints (without ``model.``).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import BLOCK_TYPES, Denoiser
from torchrl_sparse.networks.sizes import check_size

__all__ = ["BLOCK_TYPES", "MAX_LAYERS", "TransformerForDiffusion"]

_INIT_STD = 0.02
# Attention masks are as large as the square of the horizon, and a layer takes a millisecond to make.
_MAX_WIDTH, _MAX_TOKENS = 1 << 16, 4096
MAX_LAYERS = 256


class SinusoidalPosEmb(nn.Module):
    """Embedding of a timestep t as ``[sin(t f_i) | cos(t f_i)]`` with ``f_i = 10000 ** (-i / (dim / 2 - 1))``.

    Args:
        dim: size of the embedding, even and at least 4.

    Examples:
        >>> SinusoidalPosEmb(4)(torch.tensor([0])).tolist()
        [[0.0, 0.0, 1.0, 1.0]]
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        if dim < 4 or dim % 2:
            raise InputError(f"dim: expected an even number of at least 4, got {dim}")
        self.dim = dim

    def forward(self, timestep: Tensor) -> Tensor:
        """Embed ``timestep`` [B] as f32 [B, dim]."""
        half = self.dim // 2
        index = torch.arange(half, device=timestep.device)
        frequency = torch.exp(index * (-math.log(10000) / (half - 1)))
        angle = timestep[:, None] * frequency[None]
        return torch.cat((angle.sin(), angle.cos()), dim=-1)


class TransformerForDiffusion(Denoiser):
    """Noise predictor ``eps(sample, timestep, cond)`` of Diffusion Policy (arXiv:2303.04137, Table VII).

    Args:
        input_dim: size of a noisy action.
        output_dim: size of a predicted noise vector, usually ``input_dim``.
        horizon: actions in a chunk (H).
        n_obs_steps: observations that condition the chunk (To).
        cond_dim: size of one encoded observation.
        n_layer: decoder layers (L); the trunk has ``num_blocks = 3 * n_layer`` blocks.
        n_head: attention heads; divides ``n_emb``.
        n_emb: width.
        p_drop_emb: dropout on the embeddings.
        p_drop_attn: dropout in and after every block.
        causal_attn: action t attends to actions <= t and to memory tokens <= t + 1. Memory token 0 is the
            timestep, so that action 0 does not see the second observation: this is how the published models
            are trained.
        n_cond_layers: 0 makes the condition encoder a token-wise MLP (all published models), more a
            transformer encoder.

    Raises:
        InputError: if a size is no positive number or far too large, or ``n_emb`` is not a multiple of ``n_head``.

    Examples:
        >>> network = TransformerForDiffusion(
        ...     input_dim=10, output_dim=10, horizon=10, n_obs_steps=2, cond_dim=19
        ... )
        >>> sum(p.numel() for p in network.parameters()), network.num_blocks
        (8967434, 24)
        >>> network(torch.zeros(3, 10, 10), 99, torch.zeros(3, 2, 19)).shape
        torch.Size([3, 10, 10])
    """

    block_types = BLOCK_TYPES

    def __init__(
        self,
        *,
        input_dim: int,
        output_dim: int,
        horizon: int,
        n_obs_steps: int,
        cond_dim: int,
        n_layer: int = 8,
        n_head: int = 4,
        n_emb: int = 256,
        p_drop_emb: float = 0.0,
        p_drop_attn: float = 0.3,
        causal_attn: bool = True,
        n_cond_layers: int = 0,
    ) -> None:
        super().__init__()
        self.config = {
            "input_dim": input_dim,
            "output_dim": output_dim,
            "horizon": horizon,
            "n_obs_steps": n_obs_steps,
            "cond_dim": cond_dim,
            "n_layer": n_layer,
            "n_head": n_head,
            "n_emb": n_emb,
            "p_drop_emb": p_drop_emb,
            "p_drop_attn": p_drop_attn,
            "causal_attn": causal_attn,
            "n_cond_layers": n_cond_layers,
        }
        _check_config(self.config)
        for name, value in self.config.items():
            setattr(self, name, value)
        self._build()
        self._init_weights()
        self._finish()

    @property
    def like(self) -> nn.Parameter:
        """See `Denoiser.like`."""
        return self.pos_emb

    def _build(self) -> None:
        width = self.n_emb
        num_memory = 1 + self.n_obs_steps
        self.input_emb = nn.Linear(self.input_dim, width)
        self.pos_emb = nn.Parameter(torch.zeros(1, self.horizon, width))
        self.drop = nn.Dropout(self.p_drop_emb)

        self.time_emb = SinusoidalPosEmb(width)
        self.cond_obs_emb = nn.Linear(self.cond_dim, width)
        self.cond_pos_emb = nn.Parameter(torch.zeros(1, num_memory, width))
        layer_args = {
            "d_model": width,
            "nhead": self.n_head,
            "dim_feedforward": 4 * width,
            "dropout": self.p_drop_attn,
            "activation": "gelu",
            "batch_first": True,
            "norm_first": True,
        }
        if self.n_cond_layers > 0:
            self.encoder = nn.TransformerEncoder(
                nn.TransformerEncoderLayer(**layer_args), self.n_cond_layers, enable_nested_tensor=False
            )
        else:
            self.encoder = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.decoder = nn.TransformerDecoder(nn.TransformerDecoderLayer(**layer_args), self.n_layer)
        self.ln_f = nn.LayerNorm(width)
        self.head = nn.Linear(width, self.output_dim)

        mask, memory_mask = _causal_masks(self.horizon, num_memory) if self.causal_attn else (None, None)
        self.register_buffer("mask", mask, persistent=False)
        self.register_buffer("memory_mask", memory_mask, persistent=False)

    def _init_weights(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=_INIT_STD)
                nn.init.zeros_(module.bias)
            elif isinstance(module, nn.MultiheadAttention):
                nn.init.normal_(module.in_proj_weight, std=_INIT_STD)
                nn.init.zeros_(module.in_proj_bias)
        nn.init.normal_(self.pos_emb, std=_INIT_STD)
        nn.init.normal_(self.cond_pos_emb, std=_INIT_STD)

    def embed(self, sample: Tensor) -> Tensor:
        """Embed noisy actions [B, H, input_dim] as tokens [B, H, n_emb]."""
        self._check("sample", sample, (self.horizon, self.input_dim))
        return self.drop(self.input_emb(sample) + self.pos_emb)

    def memory(self, timestep: float | Tensor, cond: Tensor) -> Tensor:
        """Encode the condition tokens, [B, 1 + To, n_emb].

        Args:
            timestep: a number, or i64 [B].
            cond: encoded observations [B, To, cond_dim].
        """
        self._check("cond", cond, (self.n_obs_steps, self.cond_dim))
        time_token = self.time_emb(self._timesteps(timestep, cond)).to(cond.dtype)[:, None]
        tokens = torch.cat((time_token, self.cond_obs_emb(cond)), dim=1)
        return self.encoder(self.drop(tokens + self.cond_pos_emb))

    def block(self, index: int, x: Tensor, memory: Tensor) -> Tensor:
        """Compute the output of block ``index``, [B, H, n_emb], which is *not* yet added to the residual stream.

        Args:
            index: ``3 * layer + {0: SA, 1: CA, 2: FFN}``.
            x: residual stream [B, H, n_emb].
            memory: condition tokens of :meth:`memory`; only CA reads them.

        Examples:
            >>> sizes = dict(input_dim=2, output_dim=2, horizon=4, n_obs_steps=2, cond_dim=3)
            >>> net = TransformerForDiffusion(**sizes, n_layer=1, n_head=2, n_emb=8).eval()
            >>> x, memory = net.embed(torch.ones(1, 4, 2)), net.memory(0, torch.ones(1, 2, 3))
            >>> for index in range(net.num_blocks):
            ...     x = x + net.block(index, x, memory)
            >>> torch.equal(net.head_out(x), net(torch.ones(1, 4, 2), 0, torch.ones(1, 2, 3)))
            True
        """
        layer, kind = divmod(index, len(BLOCK_TYPES))
        layer = self.decoder.layers[layer]
        if BLOCK_TYPES[kind] == "SA":
            y = layer.norm1(x)
            y = layer.self_attn(y, y, y, attn_mask=self.mask, need_weights=False)[0]
            return layer.dropout1(y)
        if BLOCK_TYPES[kind] == "CA":
            y = layer.norm2(x)
            y = layer.multihead_attn(y, memory, memory, attn_mask=self.memory_mask, need_weights=False)[0]
            return layer.dropout2(y)
        y = layer.dropout(layer.activation(layer.linear1(layer.norm3(x))))
        return layer.dropout3(layer.linear2(y))

    def head_out(self, x: Tensor) -> Tensor:
        """Normalise the residual stream [B, H, n_emb] and project it to noise [B, H, output_dim]."""
        return self.head(self.ln_f(x))


def _causal_masks(horizon: int, num_memory: int) -> tuple[Tensor, Tensor]:
    """Make additive masks [H, H] and [H, 1 + To]: 0 where attention is allowed, -inf elsewhere."""
    step = torch.arange(horizon)[:, None]
    hidden = torch.tensor(float("-inf"))
    seen = torch.tensor(0.0)
    mask = torch.where(step >= torch.arange(horizon)[None], seen, hidden)
    memory_mask = torch.where(step >= torch.arange(num_memory)[None] - 1, seen, hidden)
    return mask, memory_mask


def _check_config(config: dict) -> None:
    for name in ("input_dim", "output_dim", "cond_dim", "n_emb", "n_head"):
        check_size(name, config[name], _MAX_WIDTH)
    for name in ("horizon", "n_obs_steps"):
        check_size(name, config[name], _MAX_TOKENS)
    check_size("n_layer", config["n_layer"], MAX_LAYERS)
    check_size("n_cond_layers", config["n_cond_layers"], MAX_LAYERS, least=0)
    if not isinstance(config["causal_attn"], bool):
        raise InputError(f"causal_attn: expected true or false, got {config['causal_attn']!r}")
    if config["n_emb"] % config["n_head"]:
        raise InputError(f"n_emb: expected a multiple of n_head={config['n_head']}, got {config['n_emb']}")
