"""Folding of memory tokens within a policy call, in preallocated memory.

:func:`~torchrl_sparse.blocks.engine.folding.fold_tokens` says what is computed; here it is a few large products.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import FoldedLayer, FoldedMemory
from torchrl_sparse.blocks.engine.torch.linear import make_linear

__all__ = ["FoldScratch", "TokenFold"]


class FoldScratch:
    """Scratch memory and result of folding N tokens; made by :meth:`TokenFold.scratch`.

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


class TokenFold:
    """Function that folds memory tokens into keys and values of width d.

    Args:
        layers: of the denoiser, folded.
        like: gives the type and device to compute in.
    """

    def __init__(self, layers: Sequence[FoldedLayer], like: Tensor) -> None:
        def stacked(tensors: Iterable[Tensor]) -> Tensor:
            return torch.stack(list(tensors)).to(like)

        heads, size, width = layers[0].query.weight.shape
        self._sizes = len(layers), heads, size, width
        self._like = like
        self._query = stacked(layer.query.weight for layer in layers).view(-1, size, width)
        self._query_bias = stacked(layer.query.bias for layer in layers).view(-1, size, 1)
        self._output = stacked(layer.cross_out.weight.movedim(0, 2) for layer in layers).view(-1, size, width)
        weight = stacked(layer.key_value.weight for layer in layers).flatten(0, 3)
        self._project = make_linear(weight, stacked(layer.key_value.bias for layer in layers).flatten())

    def scratch(self, num_tokens: int) -> FoldScratch:
        """Allocate the memory in which ``num_tokens`` tokens are folded."""
        return FoldScratch(num_tokens, self._sizes, self._like)

    def __call__(self, tokens: Tensor, scratch: FoldScratch) -> FoldedMemory:
        """Fold encoded memory ``tokens`` [N, d]; the result is that of ``scratch``, until it is used again."""
        projected = self._project(tokens, scratch.projected).view(scratch.projected_by_token)
        scratch.split.copy_(projected.permute(2, 1, 3, 0, 4))
        torch.bmm(scratch.key, self._query, out=scratch.key_vectors)
        torch.bmm(scratch.value, self._output, out=scratch.value_vectors)
        torch.bmm(scratch.key, self._query_bias, out=scratch.bias)
        return scratch.folded
