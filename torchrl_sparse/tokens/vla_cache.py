"""VLA-Cache (Xu et al., arXiv:2502.02175): reuse unchanged tokens from the last policy call instead of computing them.

Nothing is dropped. A token is reused where its patch did not change and the instruction did not attend to it; the share of such
tokens grows from layer to layer, the more, the more focused attention is.

This emulates the method. The authors put the last query's keys and values in a layer's attention and compute nothing of a
reused token. Here every token is computed, and what the last call left in the residual stream behind a layer is put in its
place, from which the next layer makes its keys and values: a layer's reuse takes effect one layer later, and none in the first.
Entropy and relevance are those of the last call, relevance that of one layer, the 15th of 32. So it shows what reuse does to
the actions, not what it saves: FLOPs and time are those of a decoder that reuses nothing.
``("tokens", "reused")`` says how many tokens a layer would be spared.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry
from torchrl_sparse.networks.vla.hooks import LayerState, VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.frames import FRAME_KEYS, compare_frames
from torchrl_sparse.tokens.selection import best, best_per_camera, check_share

CACHE = ("tokens", "cache")
REUSE_SHARE = ("tokens", "reuse_share")
REUSED = ("tokens", "reused")

_DEPTH, _TASK_LAYER = 32, 15
# What one layer leaves in the policy call's TensorDict for the next.
_REUSABLE, _ALIKE, _REUSED_NOW, _ENTROPY, _NEW_CACHE = (
    ("vla_cache", name) for name in ("reusable", "alike", "reused", "entropy", "cache")
)


def reusable_set(
    similarity: Tensor, attention: Tensor, static: int, relevant: int, threshold: float, cameras: int
) -> Tensor:
    """Choose unchanged, irrelevant tokens, bool [B, N]: per camera the ``static`` patches most similar to their predecessors,
    at least ``threshold``, except the ``relevant`` most attended ones.

    Args:
        similarity: [B, N] to the last policy call's patches.
        attention: [B, N] of the instruction's words, at the last query.
    """
    still = best_per_camera(similarity, [static] * cameras, similarity >= threshold)
    return still & ~best_per_camera(attention, [relevant] * cameras, attention.isfinite())


def attention_entropy(attention: Tensor) -> Tensor:
    """Return the entropy [B], in nats, of the attention over the visual tokens, mean over rows.

    Args:
        attention: [B, R, N]; rows of zeros do not count.
    """
    total = attention.sum(-1, keepdim=True)
    share = attention / total.clamp_min(1e-10)
    entropy = -torch.special.xlogy(share, share).sum(-1)
    real = total[..., 0] > 0
    return (entropy * real).sum(-1) / real.sum(-1).clamp_min(1)


def reuse_shares(entropy: Tensor, growth: float) -> Tensor:
    """Return the share of reusable tokens reused in each layer, [B, L]: 0 at the highest entropy to 1 at the lowest.

    Args:
        entropy: [B, L].
        growth: rises from one layer to the next are damped to this part of them.

    Examples:
        >>> reuse_shares(torch.tensor([[3.0, 1.0, 2.0]]), 0.55)
        tensor([[0.0000, 0.5500, 0.5000]])
    """
    low, high = entropy.amin(-1, keepdim=True), entropy.amax(-1, keepdim=True)
    shares = [*(1 - (entropy - low) / (high - low).clamp_min(1e-10)).unbind(-1)]
    for layer in range(1, len(shares)):
        rise = shares[layer] - shares[layer - 1]
        shares[layer] = shares[layer - 1] + torch.where(rise > 0, growth * rise, rise)
    return torch.stack(shares, -1)


class VLACachePruner(TokenPruner):
    """Pruner that reuses unchanged, irrelevant tokens from the last policy call; see the module for its limits.

    Entropy and relevance are those of the last query, over the attention of the instruction's words to the visual tokens.

    Args:
        static_share: of each camera's tokens, those that may count as unchanged at most.
        relevant_share: of each camera's tokens, the most attended, that are always computed.
        threshold: patches at least so similar are unchanged.
        growth: see `reuse_shares`.
    """

    in_keys = [*FRAME_KEYS, keys.TOKEN_SCORE, CACHE, REUSE_SHARE]
    out_keys = [keys.TOKEN_FRAMES, keys.TOKEN_SCORE, CACHE, REUSE_SHARE, REUSED]

    def __init__(
        self,
        static_share: float = 150 / 256,
        relevant_share: float = 120 / 256,
        threshold: float = 0.996,
        growth: float = 0.55,
    ):
        for name, value in {"static_share": static_share, "relevant_share": relevant_share}.items():
            check_share(name, value)
        self.static_share, self.relevant_share = static_share, relevant_share
        self.threshold, self.growth = threshold, growth

    def bind(self, spec: VisualSpec) -> None:
        self.spec = spec
        self._task_layer = round(_TASK_LAYER * spec.num_layers / _DEPTH)

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        layers = self.spec.num_layers
        cache = Entry((layers, self.spec.num_visual, self.spec.width))
        return {**super().carried(chunk), REUSE_SHARE: Entry((layers,)), CACHE: cache}

    def layers_scored(self, num_layers: int) -> set[int]:
        return set(range(num_layers))

    def begin(self, td: TensorDictBase) -> None:
        spec = self.spec
        alike, first = compare_frames(td, spec)
        attended = keys.recall(td, keys.TOKEN_SCORE, (spec.num_visual,), 0.0)
        static, relevant = (
            round(share * spec.per_camera) for share in (self.static_share, self.relevant_share)
        )
        reusable = reusable_set(alike, attended, static, relevant, self.threshold, len(spec.cameras))
        td.set(_REUSABLE, reusable & ~first)
        td.set(_ALIKE, alike)
        td.set(_REUSED_NOW, torch.zeros_like(reusable))
        td.set(_ENTROPY, torch.zeros(*td.batch_size, spec.num_layers, device=td.device))
        td.set(REUSED, torch.zeros(*td.batch_size, 1, device=td.device))

    def after_layer(self, index: int, state: LayerState) -> None:
        td, layers = state.td, self.spec.num_layers
        features = state.visual_features
        if index == 0:
            td.set(_NEW_CACHE, features.new_zeros(len(features), layers, *features.shape[1:]))
        reused = self._reused(index, td)
        cache = keys.recall(td, CACHE, (layers, *features.shape[1:]), 0.0, features.dtype)
        features = torch.where(reused[..., None], cache[:, index], features)
        state.hidden = _with_features(state, features)
        td.get(_NEW_CACHE)[:, index] = features
        td.get(_ENTROPY)[:, index] = attention_entropy(state.attention)
        td.set(REUSED, td.get(REUSED) + reused.sum(-1, keepdim=True) / layers)
        if index == self._task_layer:
            td.set(keys.TOKEN_SCORE, state.scores)

    def _reused(self, index: int, td: TensorDictBase) -> Tensor:
        """Choose the tokens that are not computed from this layer on, bool [B, N]; none of them comes back in a deeper one."""
        reusable = td.get(_REUSABLE)
        share = keys.recall(td, REUSE_SHARE, (self.spec.num_layers,), 0.0)[:, index, None]
        count = (share * reusable.sum(-1, keepdim=True)).long()
        reused = td.get(_REUSED_NOW) | best(td.get(_ALIKE), count, reusable)
        td.set(_REUSED_NOW, reused)
        return reused

    def end(self, td: TensorDictBase) -> None:
        td.set(REUSE_SHARE, reuse_shares(td.get(_ENTROPY), self.growth))
        td.set(CACHE, td.get(_NEW_CACHE).detach())


def _with_features(state: LayerState, features: Tensor) -> Tensor:
    """Return ``state.hidden`` with the visual tokens' rows taken from ``features`` [B, N, d]."""
    ids = state.visual_ids.clamp(0, state.num_visual - 1)[..., None].expand_as(state.hidden)
    return torch.where(state.is_visual[..., None], features.gather(1, ids), state.hidden)
