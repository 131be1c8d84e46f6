"""The weights of a denoiser as the native engine reads them: folded, tabulated and packed.

Everything here is exact algebra on the network of :mod:`torchrl_sparse.networks.diffusion.transformer`, done once
and in float64, so that the only rounding it adds is that of the result:

* LayerNorm's gain and shift go into the projection that follows: ``W (g * n + s) + b = (W g) n + (W s + b)``;
  1/sqrt(head size) goes into the queries.
* Cross-attention knows its 1 + To memory tokens beforehand. Of each head, the score ``q . k`` of a token is
  ``n . (Wq^T k) + bq . k`` and its contribution is ``Wo v``: two vectors of the network's width per head and
  token, and neither the query nor the output projection is left. Those of the time token are tabulated here for
  all denoising steps; those of the observations are computed within every query.
* An observation's embedding and the first layer of its encoder are one matrix.
* Position embeddings are biases of the layers before them, one row for each token.

A matrix [columns, rows] of PyTorch is cut into parts of 256 rows and these into panels of 32 columns,
[part][panel][row][32]; heads are padded to multiples of 16. ``native.cpp`` declares the same structures.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
from ctypes import POINTER, c_float, c_int32, c_void_p
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.blocks.engine.folding import after_norm

if TYPE_CHECKING:
    from torchrl_sparse.networks.diffusion.sampler import Sampler
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Arena", "Matrix", "Model", "PackedNetwork", "pack_panels"]

PANEL, PART = 32, 256
_TYPES = (torch.float32, torch.float16, torch.bfloat16)  # as native.cpp numbers them
_CACHE_LINE = 64


class Matrix(ctypes.Structure):
    """``struct Matrix`` of native.cpp; :meth:`Arena.matrix` makes one."""

    _fields_ = [
        *((name, c_void_p) for name in ("weight", "bias")),
        *((name, c_int32) for name in ("rows", "columns", "bias_stride", "type")),
    ]


class _Layer(ctypes.Structure):
    _fields_ = [
        *((name, Matrix) for name in ("qkv", "out", "up", "down", "kv")),
        ("fold", POINTER(Matrix)),
        *((name, c_void_p) for name in ("query_bias", "cross_bias")),
    ]


class Model(ctypes.Structure):
    """``struct Model`` of native.cpp."""

    _SIZES = ["horizon", "width", "layers", "heads", "obs_steps", "action_dim", "cond_dim", "steps", "causal"]
    _fields_ = [
        *((name, c_int32) for name in _SIZES),
        ("clip", c_float),
        ("layer", POINTER(_Layer)),
        *((name, Matrix) for name in ("embed", "head", "encode_up", "encode_down")),
        *((name, c_void_p) for name in ("time_key", "time_value", "time_bias", "coefficients", "valid")),
    ]


def pack_panels(weight: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """A matrix in the order in which ``native.cpp`` reads it.

    Args:
        weight: [columns, rows], as ``nn.Linear`` keeps it (outputs, inputs).
        dtype: torch.float32, torch.float16 or torch.bfloat16. Of bfloat16, each two rows become one of i32, the first
            in the lower half: CPUs multiply them in pairs.

    Returns:
        flat, part after part of up to 256 rows, in each [ceil(columns / 32), rows of the part, 32]; zero where there
        is no column.

    Raises:
        ValueError: if a weight is too large for ``dtype``.

    Examples:
        >>> pack_panels(torch.ones(40, 7)).view(2, 7, 32)[1, 0].sum()
        tensor(8.)
    """
    rounded = weight.to(dtype)
    if not rounded.isfinite().all():
        raise ValueError(
            f"weights: expected finite numbers within the range of {dtype}, got {weight.abs().max():g}"
        )
    if dtype == torch.bfloat16:
        rounded = functional.pad(rounded, (0, weight.shape[1] % 2)).contiguous().view(torch.int32)
    columns, rows = rounded.shape
    panels = functional.pad(rounded, (0, 0, 0, -columns % PANEL)).view(-1, PANEL, rows).transpose(1, 2)
    return torch.cat([part.flatten() for part in panels.split(PART, dim=1)])


class Arena:
    """Memory for constants, in large pages where the system has them: streamed weights then cost few address look-ups."""

    _BLOCK = 32 << 20

    def __init__(self) -> None:
        self._blocks: list[Tensor] = []
        self._used = self._size = 0

    def keep(self, tensor: Tensor) -> int:
        """Copy ``tensor`` and return the address of the copy, on a cache line."""
        tensor = tensor.contiguous().view(-1).view(torch.uint8)
        if self._used + tensor.numel() > self._size:
            self._size = max(self._BLOCK, tensor.numel())
            self._used = 0
            self._blocks.append(torch.frombuffer(_pages(self._size), dtype=torch.uint8))
        place = self._blocks[-1][self._used : self._used + tensor.numel()].copy_(tensor)
        self._used += -(-tensor.numel() // _CACHE_LINE) * _CACHE_LINE
        return place.data_ptr()

    def floats(self, tensor: Tensor) -> int:
        """Address of a copy of ``tensor`` as f32."""
        return self.keep(tensor.float())

    def matrix(self, weight: Tensor, bias: Tensor, dtype: torch.dtype = torch.float32) -> Matrix:
        """A layer's packed ``weight`` [columns, rows] and ``bias`` [columns], or [n, columns] for n rows of a product."""
        columns, rows = weight.shape
        bias = functional.pad(bias, (0, -columns % PANEL))
        return Matrix(
            weight=self.keep(pack_panels(weight, dtype)),
            bias=self.floats(bias),
            rows=-(-rows // 2) if dtype == torch.bfloat16 else rows,
            columns=bias.shape[-1],
            bias_stride=bias.shape[-1] if bias.ndim == 2 else 0,
            type=_TYPES.index(dtype),
        )


def _pages(size: int) -> mmap.mmap:
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return mmap.mmap(-1, size)
    # Private, because memory that processes share, the default here, is not given large pages.
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    # A kernel without large pages refuses, and nothing is lost.
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


class PackedNetwork:
    """What the native engine computes with; owns the memory that ``model`` points into.

    Args:
        network: the denoiser, on the CPU, with n_cond_layers = 0.
        sampler: the denoising steps.
        weights: type of the trunk's matrices and of the condition encoder's but the first, one of those of
            :func:`pack_panels`.

    Attributes:
        model: the structure that native.cpp reads.
    """

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler, weights: torch.dtype) -> None:
        self._weights = weights
        self._arena = Arena()
        self._arrays: list[ctypes.Array] = []  # structures only point to theirs
        self._heads = network.n_head
        self._head_size = network.n_emb // network.n_head
        self._width = -(-network.n_emb // PANEL) * PANEL
        with torch.no_grad():
            self.model = self._pack(network, sampler)

    def _pack(self, network, sampler) -> Model:
        coefficients = sampler.coefficients
        # What follows each other in the loop or before it does so in memory.
        loop = [self._pack_loop(layer) for layer in network.decoder.layers]
        layers = [
            _Layer(**loop[i], **self._pack_memory(layer)) for i, layer in enumerate(network.decoder.layers)
        ]
        tables = self._time_tables(network, sampler)
        positions = network.pos_emb[0].double()
        norm, head = network.ln_f, network.head
        valid = self._padded_width(torch.ones(network.n_emb))
        layer_array = (_Layer * len(layers))(*layers)
        self._arrays.append(layer_array)
        return Model(
            horizon=network.horizon,
            width=network.n_emb,
            layers=network.n_layer,
            heads=network.n_head,
            obs_steps=network.n_obs_steps,
            action_dim=network.input_dim,
            cond_dim=network.cond_dim,
            steps=sampler.num_inference_steps,
            causal=network.causal_attn,
            clip=coefficients.clip,
            layer=layer_array,
            embed=self._arena.matrix(network.input_emb.weight, network.input_emb.bias + positions),
            head=self._arena.matrix(*after_norm(norm, head.weight, head.bias)),
            encode_up=self._arena.matrix(*_embed_and_encode(network)),
            encode_down=self._matrix(network.encoder[2].weight, network.encoder[2].bias),
            coefficients=self._arena.floats(coefficients.table()),
            valid=self._arena.floats(valid),
            **{name: self._arena.floats(table) for name, table in tables.items()},
        )

    def _pack_loop(self, layer) -> dict[str, Matrix]:
        """The matrices of self-attention and of the feed-forward network."""
        attention = layer.self_attn
        qkv, bias = after_norm(layer.norm1, attention.in_proj_weight, attention.in_proj_bias)
        scale = torch.ones(3, 1).double()
        scale[0] = self._head_size**-0.5
        qkv, bias = qkv.unflatten(0, (3, -1)) * scale[..., None], bias.unflatten(0, (3, -1)) * scale
        out = self._per_head(attention.out_proj.weight.T).flatten(0, 1).T
        return {
            "qkv": self._matrix(self._padded_heads(qkv), self._padded_heads(bias)),
            "out": self._matrix(out, attention.out_proj.bias),
            "up": self._matrix(*after_norm(layer.norm3, layer.linear1.weight, layer.linear1.bias)),
            "down": self._matrix(layer.linear2.weight, layer.linear2.bias),
        }

    def _pack_memory(self, layer) -> dict:
        """What folds memory tokens into cross-attention."""
        key_value = [tensor.unflatten(0, (3, -1))[1:] for tensor in _in_proj(layer.multihead_attn)]
        query, query_bias, out = _cross_matrices(layer)
        kv = self._matrix(*(self._padded_heads(tensor) for tensor in key_value))
        per_head = [head.T for side in (query, out.T) for head in self._per_head(side)]
        fold = (Matrix * len(per_head))(*(self._matrix(head, torch.zeros(len(head))) for head in per_head))
        self._arrays.append(fold)
        return {
            "kv": kv,
            "fold": fold,
            "query_bias": self._arena.floats(self._per_head(query_bias)),
            "cross_bias": self._arena.floats(self._padded_width(layer.multihead_attn.out_proj.bias)),
        }

    def _time_tables(self, network, sampler) -> dict[str, Tensor]:
        """Folded keys, values [K, L, heads, width] and score biases [K, L, heads] of the time tokens."""
        up, _, down = network.encoder
        token = network.time_emb(sampler.timesteps).double() + network.cond_pos_emb[0, 0]
        token = functional.mish(functional.linear(token, up.weight.double(), up.bias.double()))
        token = functional.linear(token, down.weight.double(), down.bias.double())
        tables = {"time_key": [], "time_value": [], "time_bias": []}
        for layer in network.decoder.layers:
            weight, bias = (tensor.unflatten(0, (3, -1))[1:] for tensor in _in_proj(layer.multihead_attn))
            key, value = (torch.einsum("nod,kd->nko", weight, token) + bias[:, None]).unflatten(
                2, (self._heads, -1)
            )
            query, query_bias, out = _cross_matrices(layer)
            query, out = query.unflatten(0, (self._heads, -1)), out.unflatten(1, (self._heads, -1))
            tables["time_key"].append(torch.einsum("khc,hcd->khd", key, query))
            tables["time_value"].append(torch.einsum("khc,dhc->khd", value, out))
            tables["time_bias"].append(
                torch.einsum("khc,hc->kh", key, query_bias.unflatten(0, (self._heads, -1)))
            )
        stacked = {name: torch.stack(layers, dim=1) for name, layers in tables.items()}
        return {
            name: table if name == "time_bias" else self._padded_width(table)
            for name, table in stacked.items()
        }

    def _per_head(self, tensor: Tensor) -> Tensor:
        """[heads * size, ...] as [heads, padded size, ...]."""
        heads = tensor.double().unflatten(0, (self._heads, -1))
        return functional.pad(heads, (0, 0) * (heads.ndim - 2) + (0, -self._head_size % 16))

    def _padded_heads(self, parts: Tensor) -> Tensor:
        """[n, heads * size, ...] as [n * part, ...]: padded heads, and every part padded to whole panels."""
        flat = [self._per_head(part).flatten(0, 1) for part in parts]
        return torch.cat(
            [functional.pad(part, (0, 0) * (part.ndim - 1) + (0, -len(part) % PANEL)) for part in flat]
        )

    def _padded_width(self, tensor: Tensor) -> Tensor:
        return functional.pad(tensor, (0, self._width - tensor.shape[-1]))

    def _matrix(self, weight: Tensor, bias: Tensor) -> Matrix:
        return self._arena.matrix(weight, bias, self._weights)


def _embed_and_encode(network: TransformerForDiffusion) -> tuple[Tensor, Tensor]:
    """Weight [4d, D] and a bias for each observation token [To, 4d]."""
    embed, up = network.cond_obs_emb, network.encoder[0]
    weight = up.weight.double()
    bias = (embed.bias.double() + network.cond_pos_emb[0, 1:]) @ weight.T + up.bias
    return weight @ embed.weight.double(), bias


def _in_proj(attention) -> tuple[Tensor, Tensor]:
    return attention.in_proj_weight.double(), attention.in_proj_bias.double()


def _cross_matrices(layer) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled query weight [d, d] and bias [d] on normalised activations, and the output weight [d, d]."""
    weight, bias = (tensor.unflatten(0, (3, -1))[0] for tensor in _in_proj(layer.multihead_attn))
    weight, bias = after_norm(layer.norm2, weight, bias)
    scale = (len(weight) // layer.multihead_attn.num_heads) ** -0.5
    return weight * scale, bias * scale, layer.multihead_attn.out_proj.weight.double()
