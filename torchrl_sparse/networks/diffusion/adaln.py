"""A diffusion transformer with adaptive layer norms (DiT, arXiv:2212.09748), as LeRobot's ``multi_task_dit`` has it.

It has no memory tokens: timestep and observations shift, scale and gate every block::

    features = [time ; cond]                    K + To * D numbers
    shift, scale, gate = W silu(features) + b   of each block, three vectors of the width
    x = x + gate * SA(LN(x) (1 + scale) + shift)
    x = x + gate * FFN(LN(x) (1 + scale) + shift)

SiLU acts on each number and the features are side by side, so that ``W silu(features)`` is a sum of a part of time alone
and a part of the observations alone: exactly, up to rounding. In LeRobot's default sizes these matrices are 81 % of the
weights. The timestep's part follows from the sampler, the other is computed once a call.

Parameter names equal LeRobot's (without ``noise_predictor.``), but for attention without RoPE, which has the names of that
with RoPE. Weights are those of the same matrices, columns of the condition in the order in which this library encodes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.transformer import MAX_LAYERS, SinusoidalPosEmb
from torchrl_sparse.networks.sizes import check_size

__all__ = ["NORM_EPS", "AdaLNTransformer", "rotary_angles", "rotate"]

NORM_EPS = 1e-6
_MAX_WIDTH, _MAX_TOKENS = 1 << 16, 4096
_PARTS = 3  # shift, scale and gate


def rotary_angles(tokens: int, size: int, base: float) -> tuple[Tensor, Tensor]:
    """Return cosines and sines f32 [tokens, size] of rotary position embedding (RoPE, arXiv:2104.09864), RoFormer Eq. 34.

    Number j and number j + size / 2 of a head are a pair, which turns by ``position * base ** (-2 j / size)``.

    >>> [[round(value, 6) for value in values[1].tolist()] for values in rotary_angles(2, 2, 10000.0)]
    [[0.540302, 0.540302], [0.841471, 0.841471]]
    """
    frequency = 1.0 / (base ** (torch.arange(0, size, 2).float() / size))
    angle = torch.outer(torch.arange(tokens).float(), frequency).repeat(1, 2)
    return angle.cos(), angle.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Turn queries or keys [..., tokens, size] by `rotary_angles`."""
    first, second = x.chunk(2, dim=-1)
    return x * cos + torch.cat((-second, first), dim=-1) * sin


class AdaLNTransformer(Denoiser):
    """Predicts ``prediction(sample, timestep, cond)`` with blocks that adaptive layer norms condition (arXiv:2212.09748).

    Args:
        input_dim: size of a noisy action, and of a prediction.
        horizon: actions in a chunk (H).
        n_obs_steps: observations that condition the chunk (To).
        cond_dim: size of one encoded observation.
        n_layer: layers (L); the trunk has ``num_blocks = 2 * n_layer`` blocks, SA and FFN of each layer.
        n_head: attention heads; divides ``n_emb``.
        n_emb: width.
        time_dim: size of the timestep's embedding, even.
        rope_base: base of rotary position embedding; None has none.
        positions: whether a learned vector is added to each token.

    Raises:
        InputError: if a size is no positive number or far too large, or widths do not divide.

    Examples:
        >>> network = AdaLNTransformer(input_dim=7, horizon=16, n_obs_steps=2, cond_dim=30, n_layer=2, n_emb=64)
        >>> network(torch.zeros(3, 16, 7), 99, torch.zeros(3, 2, 30)).shape, network.num_blocks
        (torch.Size([3, 16, 7]), 4)
    """

    block_types = ("SA", "FFN")

    def __init__(
        self,
        *,
        input_dim: int,
        horizon: int,
        n_obs_steps: int,
        cond_dim: int,
        n_layer: int = 6,
        n_head: int = 8,
        n_emb: int = 512,
        time_dim: int = 256,
        rope_base: float | None = 10000.0,
        positions: bool = False,
    ) -> None:
        super().__init__()
        self.config = {
            "input_dim": input_dim,
            "horizon": horizon,
            "n_obs_steps": n_obs_steps,
            "cond_dim": cond_dim,
            "n_layer": n_layer,
            "n_head": n_head,
            "n_emb": n_emb,
            "time_dim": time_dim,
            "rope_base": rope_base,
            "positions": positions,
        }
        _check_config(self.config)
        for name, value in self.config.items():
            setattr(self, name, value)
        self.output_dim = input_dim
        self.time_dim, self.rope_base = time_dim, rope_base
        self._build(positions)
        self._finish()

    def _build(self, positions: bool) -> None:
        width, time = self.n_emb, self.time_dim
        self.input_proj = nn.Linear(self.input_dim, width)
        self.time_mlp = nn.Sequential(
            SinusoidalPosEmb(time), nn.Linear(time, 2 * time), nn.GELU(), nn.Linear(2 * time, time), nn.GELU()
        )
        self.pos_embedding = nn.Parameter(0.02 * torch.randn(1, self.horizon, width)) if positions else None
        features = time + self.n_obs_steps * self.cond_dim
        self.transformer_blocks = nn.ModuleList(
            [_Layer(width, features, len(self.block_types)) for _ in range(self.n_layer)]
        )
        self.output_proj = nn.Linear(width, self.input_dim)
        if self.rope_base is not None:
            cos, sin = rotary_angles(self.horizon, width // self.n_head, self.rope_base)
            self.register_buffer("rope_cos", cos, persistent=False)
            self.register_buffer("rope_sin", sin, persistent=False)

    @property
    def like(self) -> nn.Parameter:
        """See `Denoiser.like`."""
        return self.input_proj.weight

    def embed(self, sample: Tensor) -> Tensor:
        """Embed noisy actions [B, H, input_dim] as tokens [B, H, n_emb]."""
        self._check("sample", sample, (self.horizon, self.input_dim))
        x = self.input_proj(sample)
        return x if self.pos_embedding is None else x + self.pos_embedding

    def time_features(self, timesteps: Tensor) -> Tensor:
        """Embed timesteps [N] as [N, time_dim]."""
        sinusoids, *layers = self.time_mlp
        x = sinusoids(timesteps).to(self.like.dtype)
        for layer in layers:
            x = layer(x)
        return x

    def memory(self, timestep: float | Tensor, cond: Tensor) -> Tensor:
        """Return shift, scale and gate of every block, [B, L, 2, 3, n_emb].

        Args:
            timestep: a number, or a tensor [B].
            cond: encoded observations [B, To, cond_dim].
        """
        self._check("cond", cond, (self.n_obs_steps, self.cond_dim))
        time = self.time_features(self._timesteps(timestep, cond)).to(cond.dtype)
        features = functional.silu(torch.cat((time, cond.flatten(1)), dim=-1))
        return torch.stack([self._by_block(layer.modulation(features)) for layer in self._layers()], dim=1)

    def time_modulation(self, timesteps: Tensor) -> Tensor:
        """Return the part of `memory` that follows from the timesteps [N] alone, with the bias, [N, L, 2, 3, n_emb]."""
        features = functional.silu(self.time_features(timesteps))
        parts = [
            functional.linear(features, layer.modulation.weight[:, : self.time_dim], layer.modulation.bias)
            for layer in self._layers()
        ]
        return torch.stack([self._by_block(part) for part in parts], dim=1)

    def observation_modulation(self, cond: Tensor) -> Tensor:
        """Return the part of `memory` that follows from the observations [B, To, cond_dim] alone, [B, L, 2, 3, n_emb]."""
        features = functional.silu(cond.flatten(1))
        parts = [
            functional.linear(features, layer.modulation.weight[:, self.time_dim :])
            for layer in self._layers()
        ]
        return torch.stack([self._by_block(part) for part in parts], dim=1)

    def block(self, index: int, x: Tensor, memory: Tensor) -> Tensor:
        """Compute what block ``index`` adds to the residual stream, [B, H, n_emb]; it is *not* added here.

        Args:
            index: ``2 * layer + {0: SA, 1: FFN}``.
            x: residual stream [B, H, n_emb].
            memory: of :meth:`memory`.
        """
        number, kind = divmod(index, len(self.block_types))
        layer = self.transformer_blocks[number]
        shift, scale, gate = memory[:, number, kind, :, None].unbind(1)
        y = functional.layer_norm(x, (self.n_emb,), eps=NORM_EPS) * (1 + scale) + shift
        return gate * (self._attend(layer, y) if kind == 0 else layer.mlp(y))

    def _attend(self, layer: _Layer, y: Tensor) -> Tensor:
        heads = (self.n_head, self.n_emb // self.n_head)
        query, key, value = layer.attn["qkv_proj"](y).unflatten(-1, (3, *heads)).permute(2, 0, 3, 1, 4)
        if self.rope_base is not None:
            cos, sin = self.rope_cos.to(y.dtype), self.rope_sin.to(y.dtype)
            query, key = rotate(query, cos, sin), rotate(key, cos, sin)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return layer.attn["out_proj"](mixed.transpose(1, 2).flatten(2))

    def head_out(self, x: Tensor) -> Tensor:
        """Project the residual stream [B, H, n_emb] to a prediction [B, H, output_dim]."""
        return self.output_proj(x)

    def _layers(self) -> list[_Layer]:
        return list(self.transformer_blocks)

    def _by_block(self, modulation: Tensor) -> Tensor:
        return modulation.unflatten(-1, (len(self.block_types), _PARTS, self.n_emb))


class _Layer(nn.Module):
    """Weights of one layer."""

    def __init__(self, width: int, features: int, blocks: int) -> None:
        super().__init__()
        self.attn = nn.ModuleDict(
            {"qkv_proj": nn.Linear(width, 3 * width), "out_proj": nn.Linear(width, width)}
        )
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width)
        )
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(features, _PARTS * blocks * width))
        nn.init.zeros_(self.modulation.weight)  # every block adds nothing at first, as published
        nn.init.zeros_(self.modulation.bias)

    @property
    def modulation(self) -> nn.Linear:
        """The linear map from features to shifts, scales and gates."""
        return self.adaLN_modulation[1]


def _check_config(config: dict) -> None:
    for name in ("input_dim", "cond_dim", "n_emb", "n_head", "time_dim"):
        check_size(name, config[name], _MAX_WIDTH)
    for name in ("horizon", "n_obs_steps"):
        check_size(name, config[name], _MAX_TOKENS)
    check_size("n_layer", config["n_layer"], MAX_LAYERS)
    if not isinstance(config["positions"], bool):
        raise InputError(f"positions: expected true or false, got {config['positions']!r}")
    if config["n_emb"] % config["n_head"]:
        raise InputError(f"n_emb: expected a multiple of n_head={config['n_head']}, got {config['n_emb']}")
    base, size = config["rope_base"], config["n_emb"] // config["n_head"]
    if base is not None and (not isinstance(base, (int, float)) or isinstance(base, bool) or not base > 0):
        raise InputError(f"rope_base: expected a number above 0 or null, got {base!r}")
    if base is not None and size % 2:
        raise InputError(f"n_emb: expected heads of an even size, for RoPE, got {size}")
