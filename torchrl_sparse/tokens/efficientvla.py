"""EfficientVLA, the part that concerns the language model (Yang et al., arXiv:2506.10100): fewer layers, fewer visual tokens.

Layers that hardly change their input are left out altogether. Of the visual tokens stay a few that the instruction attends to,
and beside them some more of those and some that are unlike them. The third part, caching inside a diffusion head, has
nothing to act on in a policy that predicts actions in one pass.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.networks.vla.pruning import LayerState, TokenPruner, VisualSpec
from torchrl_sparse.tokens.selection import best, check_share

LAYER_SIMILARITY = ("tokens", "layer_similarity")


def layer_similarity(before: Tensor, after: Tensor, alive: Tensor) -> Tensor:
    """Cosine between a layer's input and its output, mean over the living tokens: [B]. One minus it is the layer's importance.

    Args:
        before, after: [B, S, d].
        alive: bool [B, S].
    """
    cosine = functional.cosine_similarity(before.float(), after.float(), dim=-1)
    return (cosine * alive).sum(-1) / alive.sum(-1)


def redundant_layers(similarity: Tensor, count: int) -> list[int]:
    """The ``count`` layers that change their input least, in ascending order.

    Args:
        similarity: [..., L], see `layer_similarity`; averaged over what it was measured on.

    Examples:
        >>> redundant_layers(torch.tensor([[0.2, 0.9, 0.7, 0.8], [0.2, 0.7, 0.6, 1.0]]), 2)
        [1, 3]
    """
    mean = similarity.reshape(-1, similarity.shape[-1]).mean(0)
    if not 0 <= count < len(mean):
        raise ValueError(f"count: expected from 0 to fewer than the {len(mean)} layers, got {count}")
    return sorted(mean.argsort(descending=True, stable=True)[:count].tolist())


def relevant_and_diverse(
    relevance: Tensor, features: Tensor, alive: Tensor, count: int, key_count: int, relevant_share: float
) -> Tensor:
    """Key tokens by relevance, then ``relevant_share`` of the rest by relevance and the others by unlikeness to the key tokens.

    Args:
        relevance: [B, N], attention of the instruction's words.
        features: [B, N, d].
        alive: bool [B, N], the tokens that compete.
        count: tokens that stay in all.
        key_count: how many of them are key tokens.
        relevant_share: the paper's alpha.

    Returns:
        bool [B, N], ``count`` True in each row, or all that compete.
    """
    key = best(relevance, key_count, alive)
    more = round(relevant_share * (count - key_count))
    relevant = key | best(relevance, key_count + more, alive)
    unit = functional.normalize(features.float(), dim=-1)
    alike = (unit @ unit.transpose(-1, -2)).masked_fill(~key[:, None], -torch.inf).amax(-1)
    return relevant | best(-alike, count - key_count - more, alive & ~relevant)


class EfficientVLAPruner(TokenPruner):
    """Skips layers, and drops visual tokens once, after two of them.

    Args:
        share: of all visual tokens that stay, in (0, 1].
        skipped: layers that are not run, see `redundant_layers`; not one of the first two, whose attention is needed.
        key_share: of the tokens that stay, those that are key tokens.
        relevant_share: of the others, those chosen by relevance; the rest are chosen for diversity.
    """

    _LAYER = 1

    def __init__(
        self,
        share: float = 0.5,
        skipped: Sequence[int] = (),
        key_share: float = 0.1,
        relevant_share: float = 0.5,
    ):
        for name, value in {"share": share, "key_share": key_share, "relevant_share": relevant_share}.items():
            check_share(name, value)
        self.share, self.key_share, self.relevant_share = share, key_share, relevant_share
        self.skipped = frozenset(skipped)

    def bind(self, spec: VisualSpec) -> None:
        wrong = sorted(layer for layer in self.skipped if not self._LAYER < layer < spec.num_layers)
        if wrong:
            raise ValueError(
                f"skipped: expected layers from {self._LAYER + 1} to {spec.num_layers - 1}, got {wrong}"
            )

    def layers_scored(self, num_layers: int) -> set[int]:
        return {self._LAYER}

    def layers_skipped(self, num_layers: int) -> set[int]:
        return set(self.skipped)

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        if state.scores is None:
            return None
        count = round(self.share * state.num_visual)
        key_count = max(1, round(self.key_share * count))
        chosen = relevant_and_diverse(
            state.scores, visual_features(state), state.visual_alive, count, key_count, self.relevant_share
        )
        return state.keep_visual(chosen)


class LayerSimilarityProbe(TokenPruner):
    """Prunes nothing and writes ``("tokens", "layer_similarity")``, f32 [*B, L], from which to pick `redundant_layers`."""

    out_keys = [LAYER_SIMILARITY]

    def bind(self, spec: VisualSpec) -> None:
        self.spec = spec

    def layers_scored(self, num_layers: int) -> set[int]:
        return set(range(num_layers))

    def begin(self, td: TensorDictBase) -> None:
        td.set(LAYER_SIMILARITY, torch.zeros(*td.batch_size, self.spec.num_layers, device=td.device))

    def score_rows(self, state: LayerState) -> Tensor:
        state.td.set("layer_input", state.hidden)
        return state.task

    def after_layer(self, index: int, state: LayerState) -> None:
        similarity = layer_similarity(state.td.get("layer_input"), state.hidden, state.alive)
        state.td.get(LAYER_SIMILARITY)[..., index] = similarity


def visual_features(state: LayerState) -> Tensor:
    """The residual stream at each visual token, [B, N, d]; 0 for those that are gone."""
    ids = torch.where(state.is_visual, state.visual_ids, state.num_visual)[..., None]
    width = state.hidden.shape[-1]
    features = state.hidden.new_zeros(len(ids), state.num_visual + 1, width)
    return features.scatter(1, ids.expand(-1, -1, width), state.hidden)[:, :-1]
