"""Weights of a denoiser in the native engine's form: folded, tabulated and packed.

Everything here is exact algebra on the network of :mod:`torchrl_sparse.networks.diffusion.transformer`, done once and in
float64, so that the only rounding it adds is that of the result. :mod:`torchrl_sparse.blocks.engine.folding` does it;
what it returns is packed here:

* Of cross-attention no query and no output projection is left. The folded vectors of the time token are tabulated for
  all denoising steps; those of the observations are computed within every query, with one small matrix per head and side.
* An observation's embedding and the first layer of its encoder are one matrix.
* Position embeddings are biases of the layers before them, one row for each token.

Heads are padded to multiples of 16, rows to whole panels. ``layout.h`` describes the structures.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import (
    Affine,
    FoldedLayer,
    MemoryEncoder,
    after_norm,
    fold_layers,
    fold_observation_stem,
    fold_tokens,
)
from torchrl_sparse.blocks.engine.native.arena import PANEL, Arena, padded
from torchrl_sparse.blocks.engine.native.layout import CONSTANTS, Layer, Matrix, Model, Units
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.storage.tensors import check_shapes

__all__ = ["PackedNetwork", "PackedWeights", "units", "weight_type"]

_WEIGHTS = ("float32", "float16", "bfloat16", "int8")

_HEAD = CONSTANTS["HEAD"]  # heads are padded to whole vectors


class PackedWeights:
    """A network's weights packed for the native engine, independent of the sampler; owns their memory.

    Args:
        network: the denoiser, on the CPU, with n_cond_layers = 0.
        dtype: type of the trunk's matrices and of the condition encoder's but the first, one of those of
            :func:`~torchrl_sparse.blocks.engine.native.arena.pack_panels`; of int8, the encoder's and what folds its
            tokens, which are read once a policy call, stay f32.
        narrow: keep f32 matrices that are read once a call as f16 where all their weights are f16 numbers, as those of
            files in fp16 are: the same numbers in half the memory.

    Attributes:
        members: of the structure `Model`.

    Raises:
        InputError: naming a weight that has another shape than the network was made with.
    """

    def __init__(self, network: TransformerForDiffusion, dtype: torch.dtype, *, narrow: bool = True) -> None:
        self._weights, self._once = dtype, torch.float32 if dtype == torch.int8 else dtype
        self._narrow = narrow
        self._arena = Arena()
        self._arrays: list[ctypes.Array] = []  # structures only point to theirs
        # What is read beyond its end would not be noticed.
        check_shapes("network", network.present_shapes(), network.made_shapes)
        with torch.no_grad():
            self.members = self._pack(network)

    def _pack(self, network: TransformerForDiffusion) -> dict[str, object]:
        layers, head = fold_layers(network), network.head
        # What follows each other in the loop or before it does so in memory.
        loop = [self._pack_loop(layer) for layer in layers]
        packed = [
            Layer(**blocks, **self._pack_memory(layer)) for blocks, layer in zip(loop, layers, strict=True)
        ]
        return {
            "layer": self._array(Layer, packed),
            "embed": self._arena.matrix(
                network.input_emb.weight, network.input_emb.bias + network.pos_emb[0].double()
            ),
            "head": self._arena.matrix(*after_norm(network.ln_f, Affine(head.weight, head.bias))),
            "encode_up": self._arena.matrix(*fold_observation_stem(network)),
            "encode_down": self._read_once(network.encoder[2].weight, network.encoder[2].bias),
            "valid": self._arena.columns(torch.ones(network.n_emb)),
        }

    def _pack_loop(self, layer: FoldedLayer) -> dict[str, Matrix]:
        """Pack the matrices of self-attention and of the feed-forward network."""
        weight = padded(layer.out.weight, _HEAD, dim=2).flatten(1)
        return {
            "qkv": self._matrix(*map(_parts, layer.qkv)),
            "out": self._matrix(weight, layer.out.bias),
            "up": self._matrix(*layer.up),
            "down": self._matrix(*layer.down),
        }

    def _pack_memory(self, layer: FoldedLayer) -> dict[str, object]:
        """Pack what folds memory tokens into cross-attention."""
        query, out = layer.query.weight, layer.cross_out.weight.movedim(0, 2)
        kv = self._read_once(*map(_parts, layer.key_value))
        heads = [padded(head, _HEAD, dim=0).T for side in (query, out) for head in side]
        return {
            "kv": kv,
            "fold": self._array(Matrix, [self._read_once(head, torch.zeros(len(head))) for head in heads]),
            "query_bias": self._arena.floats(padded(layer.query.bias, _HEAD, dim=1)),
            "cross_bias": self._arena.columns(layer.cross_out.bias),
        }

    def _array(self, kind: type[ctypes.Structure], members: list) -> ctypes.Array:
        array = (kind * len(members))(*members)
        self._arrays.append(array)
        return array

    def _matrix(self, weight: Tensor, bias: Tensor) -> Matrix:
        return self._arena.matrix(weight, bias, self._weights)

    def _read_once(self, weight: Tensor, bias: Tensor) -> Matrix:
        """Pack a matrix that takes longer to read than to multiply: in half the memory if nothing of it is lost so."""
        dtype = self._once
        if self._narrow and dtype == torch.float32 and torch.equal(weight.half().to(weight.dtype), weight):
            dtype = torch.float16
        return self._arena.matrix(weight, bias, dtype)


class PackedNetwork:
    """A network and a sampler packed for the native engine; owns the memory that ``model`` points into.

    Args:
        network: that was packed.
        sampler: the denoising steps.
        weights: of the network.

    Attributes:
        model: the structure that the engine reads.
        weights: as given.
        scratch: floats that a thread needs for a policy call; the engine, which knows compiled code, says so.
    """

    scratch: int

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler, weights: PackedWeights) -> None:
        self.weights, self._arena = weights, Arena()
        self._sizes = {
            "noise": (sampler.num_inference_steps, network.horizon, network.input_dim),
            "cond": (network.n_obs_steps, network.cond_dim),
            "mask": (sampler.num_inference_steps, network.num_blocks),
        }
        with torch.no_grad():
            self.model = Model(
                horizon=network.horizon,
                width=network.n_emb,
                layers=network.n_layer,
                heads=network.n_head,
                obs_steps=network.n_obs_steps,
                action_dim=network.input_dim,
                cond_dim=network.cond_dim,
                steps=sampler.num_inference_steps,
                causal=network.causal_attn,
                history=sampler.coefficients.history,
                clip=sampler.coefficients.clip,
                coefficients=self._arena.floats(sampler.coefficients.table()),
                **weights.members,
                **self._time_tables(network, sampler),
            )

    def check(self, **query: Tensor) -> None:
        """Raise InputError unless ``noise``, ``cond`` and ``mask`` of a policy call have the packed sizes."""
        for name, tensor in query.items():
            if tuple(tensor.shape[1:]) != self._sizes[name]:
                raise InputError(
                    f"{name}: expected [B, *{self._sizes[name]}] as it was packed, got {list(tensor.shape)}"
                )

    def _time_tables(self, network: TransformerForDiffusion, sampler: Sampler) -> dict[str, int]:
        """Tabulate folded keys, values [K, L, heads, width] and score biases [K, L, heads] of the time tokens."""
        encoder = MemoryEncoder(network, sampler.timesteps, torch.float64)
        vectors, bias = fold_tokens(fold_layers(network), encoder.time_tokens())
        keys, values = vectors.permute(1, 2, 0, 3, 4)
        return {
            "time_key": self._arena.columns(keys),
            "time_value": self._arena.columns(values),
            "time_bias": self._arena.floats(bias.transpose(0, 1)),
        }


def weight_type(name: str) -> torch.dtype:
    """Return the weight type of that name, or raise InputError if there is none."""
    if name not in _WEIGHTS:
        raise InputError(f"weights: expected one of {list(_WEIGHTS)}, got {name!r}")
    return getattr(torch, name)


def _parts(tensor: Tensor) -> Tensor:
    """Flatten [n, heads, size, ...] into [n * part, ...]: heads are padded, and every part to whole panels."""
    return padded(padded(tensor, _HEAD, dim=2).flatten(1, 2), PANEL, dim=1).flatten(0, 1)


def units(normalizer: Normalizer) -> Units:
    """Return a structure that points to the buffers of ``normalizer``."""
    return Units(*(normalizer._buffers[field[0]].data_ptr() for field in Units._fields_))
