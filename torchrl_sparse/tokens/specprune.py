"""SpecPrune-VLA: visual tokens chosen from the last policy call, from image changes, and from the decoder's first layers.

Wang et al., "SpecPrune-VLA: Accelerating Vision-Language-Action Models via Action-Aware Self-Speculative Pruning",
arXiv:2509.05614. Nothing is trained. Each equation is the function named after what it defines:

====== ================================= =============================================================================
Eq.    function                          defines
====== ================================= =============================================================================
1      `visual_scores` (`vla.decoder`)   attention of the instruction's words to a visual token
2      `similarity` (`tokens.frames`)    cosine between a patch and the same patch at the last call
3      `dynamic_set`                     patches that changed
4      `layer_set`                       the best tokens of one layer, in each camera
5      `local_set`                       their union over the first two layers: the speculation
6      `retain_set`                      what static pruning keeps
7      `layer_score`                     a token's importance in one layer
8      `rank_weight`                     from the token's place in that layer
9      `confidence`                      of the layer
10     `updated_score`                   moving average over the layers that are scored: the first two, the dynamic ones
                                         and those whose scores are carried, 0, 1, 5, 10, 15 and 20 of 32
11, 12 `translation_speed`, `rotation_…` the controller, `control.action_aware`, which grants the budget
====== ================================= =============================================================================

The numbers of Eqs. 3 and 4 are inferred. What the paper leaves open is settled so: the carried score is the mean of Eq. 1 over
two deep layers, 0 for tokens that were gone there. It contributes as many tokens as one layer does, and changes at most as many
(K_G = K_D = K). The threshold of Eq. 2 and a dynamic layer's share are the release's. An episode's first call keeps all.
Of 512 visual tokens 192 stay after two layers and 80 after the last where the four sets of a coarse call do not overlap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import LayerState, VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.frames import FRAME_KEYS, compare_frames, past_frame_keys
from torchrl_sparse.tokens.selection import (
    best,
    best_per_camera,
    check_budget,
    check_share,
    ranks,
    scaled_layers,
)

# -- equations -------------------------------------------------------------------------------------------------------


def dynamic_set(similarity: Tensor, counts: list[Tensor], threshold: float) -> Tensor:
    """Choose each camera's ``counts`` most changed patches among those less similar than ``threshold``, bool [B, N] (Eq. 3).

    Args:
        similarity: [B, N], Eq. 2.
        counts: i64 [B, 1] for each camera.
    """
    return best_per_camera(-similarity, counts, similarity < threshold)


def layer_set(score: Tensor, counts: list[Tensor], alive: Tensor) -> Tensor:
    """Choose each camera's ``counts`` tokens to which one layer's words attend most, bool [B, N] (Eq. 4)."""
    return best_per_camera(score, counts, alive)


def local_set(first: Tensor, second: Tensor) -> Tensor:
    """Return the tokens that either of the first two layers picks (Eq. 5)."""
    return first | second


def retain_set(carried: Tensor, dynamic: Tensor, local: Tensor) -> Tensor:
    """Return the tokens important at the last policy call, changed since, or picked by this call's first layers (Eq. 6)."""
    return carried | dynamic | local


def layer_score(rank_weight: Tensor, confidence: Tensor) -> Tensor:
    """Return a layer's scores [B, N] from a weight per token and the layer's confidence, [B, 1] (Eq. 7)."""
    return rank_weight * confidence


def rank_weight(rank: Tensor, alive: Tensor, steepness: float) -> Tensor:
    """Return the rank weights [B, N]: sigmoid(-steepness * rank), 0 for dead tokens, normalised to sum 1 (Eq. 8).

    Args:
        rank: i64 [B, N], 0 for the token of highest attention.
        alive: bool [B, N].
    """
    weight = torch.sigmoid(-steepness * rank) * alive
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)


def confidence(score: Tensor, alive: Tensor, epsilon: float = 1e-6) -> Tensor:
    """Return the mean of the living tokens' scores over their standard deviation, [B, 1] (Eq. 9)."""
    count = alive.sum(-1, keepdim=True).clamp_min(1)
    mean = (score * alive).sum(-1, keepdim=True) / count
    variance = ((score - mean).square() * alive).sum(-1, keepdim=True) / count
    return mean / (variance.sqrt() + epsilon)


def updated_score(before: Tensor, layer_score: Tensor, beta: float) -> Tensor:
    """Return ``(1 - beta) * before + beta * layer_score`` (Eq. 10)."""
    return (1 - beta) * before + beta * layer_score


# -- the method ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpecPruneOptions:
    """Settings that differ between paper and release. Layers are for a 32-layer decoder and are scaled to the model's depth.

    Attributes:
        alpha: multiplies the budget: K = floor(alpha * camera share * budget) tokens per camera.
        budget: tokens per camera where no controller grants them.
        wrist_share: share of the budget for each camera but the first.
        threshold: patches less similar than this (Eq. 2) have changed.
        look_back: since when: so many policy calls for a hand at rest, one for a swift one, see `tokens.frames.look_back`.
        static_share: None: what changed joins in up to the budget (Eq. 3). Else the release's rule: everything stays but the
            most similar patches, up to this share of a camera in coarse and in fine mode.
        carry: use the last call's scores (the set V_global of Eq. 6).
        changed: use what changed since the last call (V_dynamic).
        local: use what this call's first two layers pick (V_local).
        early: None, or prune after the first layer as well, to so many times K.
        dynamic: prune in deeper layers.
        dynamic_layers, keep_share: where, and the share of the visual tokens that stays each time.
        carry_layers: whose scores are carried to the next call.
        beta, steepness: of Eqs. 10 and 8; the paper does not give the latter.
    """

    alpha: float = 1.0
    budget: float = 24.0
    wrist_share: float = 1.0
    threshold: float = 0.986
    look_back: int = 1
    static_share: tuple[float, float] | None = None
    carry: bool = True
    changed: bool = True
    local: bool = True
    early: float | None = None
    dynamic: bool = True
    dynamic_layers: tuple[int, ...] = (5, 10, 15, 20)
    keep_share: float = 0.8
    carry_layers: tuple[int, ...] = (15, 20)
    beta: float = 0.2
    steepness: float = 0.05


PRESETS = {
    "paper": SpecPruneOptions(),
    # Documented deviations of the release of August 2025, without its bugs: 200 of 256 patches may count as static, 220 in fine
    # mode; no carried scores; r = 0.8; fewer tokens for the wrist; no dynamic pruning unless asked for. Its controller is
    # ActionAwareController("commanded", coarse=20, fine=32).
    "release": SpecPruneOptions(
        alpha=0.8,
        budget=20.0,
        wrist_share=0.75,
        static_share=(200 / 256, 220 / 256),
        carry=False,
        early=3.0,
        dynamic=False,
        dynamic_layers=(5, 10, 15, 20, 25),
    ),
}

_DEPTH = 32
_SPECULATION = 2  # layers that see all tokens
# What one layer leaves in the policy call's TensorDict for the next.
_COUNTS, _CARRIED, _CHANGED, _FIRST, _RUNNING, _TO_CARRY = (
    ("specprune", name) for name in ("counts", "carried", "changed", "first", "running", "to_carry")
)


class SpecPrune(TokenPruner):
    """Pruner with static pruning after two layers and dynamic pruning in deeper ones; see the module.

    The budget is ``("tokens", "budget")``, per sample, where an `ActionAwareController` writes it. Scores and images of the
    last policy call travel as ``("tokens", "score")`` and ``("tokens", "frames")``.

    Args:
        preset: ``"paper"`` or ``"release"``.
        changes: `SpecPruneOptions` that differ from the preset's.

    Raises:
        InputError: for an unknown preset or an option out of its range; and when it is assigned to a model, or run, with a
            budget larger than the model's tokens.

    Examples:
        >>> pruner = SpecPrune(alpha=0.5)
        >>> pruner.bind(VisualSpec(32, (keys.IMAGE, keys.WRIST_IMAGE), (16, 16), 224, 4096))
        >>> sorted(pruner.layers_scored(32))
        [0, 1, 5, 10, 15, 20]
    """

    def __init__(self, preset: Literal["paper", "release"] = "paper", **changes: Any):
        if preset not in PRESETS:
            raise InputError(f"preset: expected 'paper' or 'release', got {preset!r}")
        self.options = replace(PRESETS[preset], **changes)
        for name in ("keep_share", "wrist_share", "beta"):
            check_share(name, getattr(self.options, name))
        if not (self.options.carry or self.options.changed or self.options.local):
            raise InputError("SpecPrune: expected one of carry, changed and local, got none: nothing stays")
        self.look_back = self.options.look_back
        past = past_frame_keys(self.look_back)
        self.in_keys = [*FRAME_KEYS, *past, keys.TOKEN_BUDGET]
        self.in_keys += [keys.FINE] if self.options.static_share else []
        self.in_keys += [keys.TOKEN_SCORE] if self.options.carry else []
        self.out_keys = [keys.TOKEN_FRAMES, *past[:1], *([keys.TOKEN_SCORE] if self.options.carry else [])]

    def bind(self, spec: VisualSpec) -> None:
        if spec.num_layers <= _SPECULATION:
            raise InputError(f"SpecPrune: expected more than {_SPECULATION} layers, got {spec.num_layers}")
        check_budget("alpha * budget", self.options.alpha * self.options.budget, spec)
        self.spec = spec
        self._dynamic_layers = self._scaled(self.options.dynamic_layers) if self.options.dynamic else []
        self._carry_layers = self._scaled(self.options.carry_layers) if self.options.carry else []

    def _scaled(self, layers: tuple[int, ...]) -> list[int]:
        return scaled_layers(layers, _DEPTH, self.spec.num_layers, first=_SPECULATION)

    def layers_scored(self, num_layers: int) -> set[int]:
        return {*range(_SPECULATION), *self._dynamic_layers, *self._carry_layers}

    def layers_watched(self, num_layers: int) -> set[int]:
        return set()

    def begin(self, td: TensorDictBase) -> None:
        """Compute what is known before the decoder runs: the budgets, the carried set, and the changed set."""
        alike, first = compare_frames(td, self.spec, self.options.look_back)
        counts = self._counts(td)
        td.set(_COUNTS, torch.cat(counts, -1))
        td.set(_CARRIED, self._carried_set(td, counts))
        td.set(_CHANGED, first | self._changed_set(td, alike, counts))
        td.set(_TO_CARRY, torch.zeros_like(alike))

    def _counts(self, td: TensorDictBase) -> list[Tensor]:
        """Return K of each camera, i64 [B, 1]."""
        granted = self.options.alpha * keys.recall(td, keys.TOKEN_BUDGET, (1,), self.options.budget).double()
        check_budget("alpha * budget", granted.max().item(), self.spec)
        shares = [1.0, *[self.options.wrist_share] * (len(self.spec.cameras) - 1)]
        # The little that is added keeps 0.29 * 100 from being 28.
        return [(granted * share + 1e-6).long() for share in shares]

    def _carried_set(self, td: TensorDictBase, counts: list[Tensor]) -> Tensor:
        carried = keys.recall(td, keys.TOKEN_SCORE, (self.spec.num_visual,), 0.0)
        return best_per_camera(carried, counts, carried > 0)

    def _changed_set(self, td: TensorDictBase, alike: Tensor, counts: list[Tensor]) -> Tensor:
        if not self.options.changed:
            return torch.zeros_like(alike, dtype=torch.bool)
        if self.options.static_share is None:
            return dynamic_set(alike, counts, self.options.threshold)
        coarse, fine = (int(share * self.spec.per_camera) for share in self.options.static_share)
        limit = torch.where(keys.recall(td, keys.FINE, (1,), False), fine, coarse)
        static = best_per_camera(alike, [limit] * len(counts), alike >= self.options.threshold)
        return ~static

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        if state.scores is None:
            return None
        self._accumulate(index, state, state.scores)
        if index < _SPECULATION:
            return self._speculate(index, state)
        return self._prune_further(state) if index in self._dynamic_layers else None

    def _accumulate(self, index: int, state: LayerState, scores: Tensor) -> None:
        """Eqs. 7 to 10, and the score to carry."""
        td, alive = state.td, state.visual_alive
        weight = rank_weight(ranks(scores, alive), alive, self.options.steepness)
        now = layer_score(weight, confidence(scores, alive))
        td.set(_RUNNING, now if index == 0 else updated_score(td.get(_RUNNING), now, self.options.beta))
        if index in self._carry_layers:
            td.set(_TO_CARRY, td.get(_TO_CARRY) + scores / len(self._carry_layers))

    def _speculate(self, index: int, state: LayerState) -> Tensor | None:
        """Eqs. 4 to 6: the sets of the first two layers, and static pruning."""
        td, alive, counts = state.td, state.visual_alive, [*state.td.get(_COUNTS).split(1, -1)]
        chosen = layer_set(state.scores, counts, alive)
        if index == 0:
            td.set(_FIRST, chosen)
            if self.options.early is None:
                return None
            local = layer_set(state.scores, [(self.options.early * count).long() for count in counts], alive)
        else:
            local = local_set(td.get(_FIRST), chosen)
        return state.keep_visual(retain_set(td.get(_CARRIED), td.get(_CHANGED), local & self.options.local))

    def _prune_further(self, state: LayerState) -> Tensor:
        """Return the ``keep_share`` of the living visual tokens with the highest running score."""
        alive = state.visual_alive
        count = (alive.sum(-1, keepdim=True) * self.options.keep_share).ceil().long()
        return state.keep_visual(best(state.td.get(_RUNNING), count, alive))

    def end(self, td: TensorDictBase) -> None:
        if self.options.carry:
            td.set(keys.TOKEN_SCORE, td.get(_TO_CARRY))
