"""A pruner that keeps an episode's first policy call dense, as pruners that compare successive calls do."""

from __future__ import annotations

from collections.abc import Set

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import LayerState, VisualSpec
from torchrl_sparse.tokens.base import TokenPruner

__all__ = ["DenseFirst"]


class DenseFirst(TokenPruner):
    """Wrapper of another pruner that keeps all tokens in rows with ``"is_init"``.

    SpecPrune and frame difference see an episode's first policy call whole, since nothing is known of the scene yet. A control
    that is to be compared with them gets the same.

    Args:
        inner: that pruner.

    Raises:
        InputError: when it is assigned to a model, if ``inner`` skips layers, which it does for a whole batch.

    Examples:
        >>> from torchrl_sparse.tokens.random import RandomPruner
        >>> DenseFirst(RandomPruner(0.5)).in_keys[-1]
        'is_init'
    """

    def __init__(self, inner: TokenPruner):
        self.inner = inner
        self.in_keys = list(dict.fromkeys([*inner.in_keys, keys.IS_INIT]))
        self.out_keys = inner.out_keys

    def bind(self, spec: VisualSpec) -> None:
        if skipped := self.inner.layers_skipped(spec.num_layers):
            raise InputError(
                f"inner: expected a pruner that skips no layers, got one that skips {sorted(skipped)}"
            )
        self.inner.bind(spec)

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        return self.inner.carried(chunk)

    def layers_scored(self, num_layers: int) -> set[int]:
        return self.inner.layers_scored(num_layers)

    def layers_watched(self, num_layers: int) -> Set[int]:
        return self.inner.layers_watched(num_layers)

    def begin(self, td: TensorDictBase) -> None:
        self.inner.begin(td)
        if keys.KEEP_MASK in self.out_keys:
            td.set(keys.KEEP_MASK, td.get(keys.KEEP_MASK) | keys.read(td, keys.IS_INIT))

    def before_layers(self, state: LayerState) -> None:
        self.inner.before_layers(state)

    def score_rows(self, state: LayerState) -> Tensor:
        return self.inner.score_rows(state)

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        first, before = keys.read(state.td, keys.IS_INIT), state.hidden
        keep = self.inner.after_layer(index, state)
        if state.hidden is not before:
            state.hidden = torch.where(first[..., None], before, state.hidden)
        return None if keep is None else keep | first

    def end(self, td: TensorDictBase) -> None:
        self.inner.end(td)
