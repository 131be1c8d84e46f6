"""The PyTorch engine of denoisers with adaptive layer norms (`AdaLNTransformer`): fewer operations, the same results.

What is exact, and saved in dense policy calls too: a modulation is a sum of a part of the timestep, tabulated with the sampler,
and a part of the observations, computed once a query, so that its matrices are read once instead of K times; angles of RoPE
are tabulated, the pairs that they turn lie beside each other, so that turning is one complex product; layers' matrices are
packed. Modulations of pruned blocks are not added up. A step without a computed block is its embedding, a sum and the head.

Rows of a batch that compute a block are gathered where masks differ. It runs on any device, on a GPU operation by operation.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.blocks.engine.program import COLLAPSE, COMPUTE, slot_counts
from torchrl_sparse.blocks.engine.torch.linear import Linear, make_linear
from torchrl_sparse.blocks.engine.torch.program import Loop
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.networks.diffusion.adaln import NORM_EPS, AdaLNTransformer
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["AdaLNTables", "run_loop"]

# of (x [N, H, d], modulation [N, 3, d]), what a block adds
Block = Callable[[Tensor, Tensor], Tensor]


class AdaLNTables:
    """A snapshot of the weights of a network's layers, prepared, and of the sampler.

    Args:
        network: the denoiser; what observations modulate is read from it in each policy call.
        sampler: the sampler.

    Attributes:
        blocks: one callable for each column of a mask.
        time: the modulation of each denoising step and block that the timestep alone decides, [K, 2L, 3, d]; 1 is added
            to its scales.
    """

    def __init__(self, network: AdaLNTransformer, sampler: Sampler) -> None:
        self.network, self.sampler = network, sampler
        self.device = network.like.device
        stem, head = network.input_proj, network.output_proj
        self._stem = stem.weight.detach().T.clone()
        place = 0 if network.pos_embedding is None else network.pos_embedding.detach()[0]
        self._start = (stem.bias.detach() + place).expand(network.horizon, -1).clone()
        self._head = head.weight.detach().clone(), head.bias.detach().clone()
        turn = None if network.rope_base is None else torch.complex(network.rope_cos, network.rope_sin)
        self.blocks: list[Block] = []
        for layer in network.transformer_blocks:
            attention = layer.attn["qkv_proj"], layer.attn["out_proj"]
            self.blocks.append(_SelfAttention(*attention, network.n_head, turn))
            self.blocks.append(_FeedForward(layer.mlp[0], layer.mlp[2]))
        time = network.time_modulation(sampler.timesteps.to(self.device)).flatten(1, 2)
        time[:, :, 1] += 1
        self.time = time.contiguous()

    def embed(self, sample: Tensor) -> Tensor:
        """Embed noisy actions [B, H, A] as tokens [B, H, d]."""
        return torch.matmul(sample, self._stem).add_(self._start)

    def predict(self, x: Tensor) -> Tensor:
        """Predict from the residual stream, [B, H, A]."""
        return functional.linear(x, *self._head)

    def modulation(self, cond: Tensor) -> Tensor:
        """Return the observations' part of each block, [2L, B, 3, d]."""
        return self.network.observation_modulation(cond).flatten(1, 2).transpose(0, 1).contiguous()


class _SelfAttention:
    """What a self-attention block adds.

    Args:
        qkv, out: its linear maps.
        heads: number of heads.
        turn: complex angles of RoPE [H, d_head], of which the second half repeats the first; None turns nothing.
    """

    def __init__(self, qkv: torch.nn.Linear, out: torch.nn.Linear, heads: int, turn: Tensor | None) -> None:
        weight, bias = qkv.weight.detach(), qkv.bias.detach()
        self._heads, self._size = heads, weight.shape[1] // heads
        self._turn = None
        if turn is not None:
            # Number j of a head and number j + size / 2 come to lie beside each other, in queries and keys alike.
            order = torch.arange(self._size, device=weight.device).unflatten(0, (2, -1)).T.flatten()
            places = (
                torch.arange(len(bias), device=weight.device).unflatten(0, (3, heads, self._size)).clone()
            )
            places[:2] = places[:2, :, order]
            weight, bias = weight[places.flatten()], bias[places.flatten()]
            double = torch.complex128 if weight.dtype == torch.float64 else torch.complex64
            self._turn = turn[:, None, None, : self._size // 2].to(double)
        self._project = make_linear(weight, bias)
        self._output = make_linear(out.weight, out.bias)

    def __call__(self, x: Tensor, modulation: Tensor) -> Tensor:
        rows, horizon, width = x.shape
        y = _modulated(x, modulation).view(-1, width)
        qkv = self._project(y, y.new_empty(len(y), 3 * width))
        parts = qkv.view(rows, horizon, 3, self._heads, self._size)
        if self._turn is not None:
            pairs = torch.view_as_complex(parts[:, :, :2].unflatten(-1, (-1, 2)))
            pairs.mul_(self._turn)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        joined = mixed.transpose(1, 2).reshape(-1, width)
        return self._output(joined, y).view(x.shape) * modulation[:, 2, None]


class _FeedForward:
    """What a feed-forward block adds."""

    def __init__(self, up: torch.nn.Linear, down: torch.nn.Linear) -> None:
        self._hidden = up.out_features
        self._inner: Linear = make_linear(up.weight, up.bias, gelu="tanh")
        self._outer: Linear = make_linear(down.weight, down.bias)

    def __call__(self, x: Tensor, modulation: Tensor) -> Tensor:
        y = _modulated(x, modulation).view(-1, x.shape[-1])
        hidden = self._inner(y, y.new_empty(len(y), self._hidden))
        return self._outer(hidden, y).view(x.shape) * modulation[:, 2, None]


def _modulated(x: Tensor, modulation: Tensor) -> Tensor:
    y = functional.layer_norm(x, (x.shape[-1],), eps=NORM_EPS)
    return torch.addcmul(modulation[:, 0, None], y, modulation[:, 1, None])


def run_loop(
    tables: AdaLNTables, loop: Loop, noise: Tensor, cond: Tensor, reuse: str, guide: Guide | None
) -> Tensor:
    """Return the actions [B, H, A] of one policy call, see :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`.

    Args:
        tables: of the network and the sampler.
        loop: the program of its masks.
        noise, cond, guide: see there.
        reuse: a rule.
    """
    network, sampler = tables.network, tables.sampler
    observed = tables.modulation(cond)
    slots = num_buffers(reuse, network.num_blocks, network.block_types)  # type: ignore[arg-type]  # checked before
    shape = (len(noise), network.horizon, network.n_emb)
    latest = noise.new_empty(0 if loop.dense else slots, *shape)
    sample, cleans = noise[:, 0], ()
    collapsed = noise.new_empty(0)
    for step, ops in enumerate(loop.steps):
        time, x = tables.time[step], tables.embed(sample)
        for op, first, last, rows in ops:
            if op == COLLAPSE:
                if first:  # what all blocks add, again
                    collapsed = _reused(latest, 0, network.num_blocks)
                x = x + collapsed
            elif op != COMPUTE:
                x = x + _reused(latest, first, last)
            elif rows is None:
                added = tables.blocks[first](x, time[first] + observed[first])
                x = x + added
                if len(latest):
                    latest[first % slots] = added
            else:
                added = tables.blocks[first](x[rows], time[first] + observed[first, rows])
                latest[first % slots, rows] = added
                x = x + latest[first % slots]
        predicted, before = tables.predict(x), sample
        following = noise[:, step + 1] if step + 1 < noise.shape[1] else None
        sample = sampler.step(predicted, step, before, following, cleans, guide)
        cleans = sampler.remember(cleans, predicted, step, before, guide)
    return sample


def _reused(latest: Tensor, first: int, last: int) -> Tensor:
    """Sum what the pruned blocks ``first .. last-1`` add."""
    counts = slot_counts(first, last, len(latest))
    if max(counts) == 1:
        used = [slot for slot, count in enumerate(counts) if count]
        return latest[used].sum(0) if len(used) < len(latest) else latest.sum(0)
    return torch.tensordot(torch.tensor(counts).to(latest), latest, dims=1)
