"""EfficientVLA's language-model part (Yang et al., arXiv:2506.10100): fewer layers, fewer visual tokens.

Layers that hardly change their input are skipped. Visual tokens are chosen in three rounds: a few key tokens to which the
instruction attends most; more tokens by the same attention; and, for diversity, those least similar to the key tokens. The
paper's third part, caching inside a diffusion head, has nothing to act on in a policy that predicts actions in one pass.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import LayerState, VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.selection import best, check_share


def relevant_and_diverse(
    relevance: Tensor, features: Tensor, alive: Tensor, count: int, key_count: int, relevant_share: float
) -> Tensor:
    """Choose key tokens by relevance, then ``relevant_share`` of the rest by relevance and the others by diversity.

    Diverse are the tokens that are least similar to any key token.

    Args:
        relevance: [B, N], attention of the instruction's words.
        features: [B, N, d].
        alive: bool [B, N], the tokens that compete.
        count: tokens that stay in all.
        key_count: key tokens among them.
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
    """Pruner that skips layers and drops visual tokens once, after the first two layers.

    Args:
        share: of all visual tokens that stay, in (0, 1].
        skipped: layers that are not run, none of the first two, whose attention is needed. The paper takes those whose output
            is most similar to their input, see `redundant_layers`. None of them is the half of the method that is about tokens.
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
            raise InputError(
                f"skipped: expected layers from {self._LAYER + 1} to {spec.num_layers - 1}, got {wrong}"
            )

    def layers_scored(self, num_layers: int) -> set[int]:
        return {self._LAYER}

    def layers_watched(self, num_layers: int) -> set[int]:
        return set()

    def layers_skipped(self, num_layers: int) -> set[int]:
        return set(self.skipped)

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        if state.scores is None:
            return None
        count = round(self.share * state.num_visual)
        key_count = max(1, round(self.key_share * count))
        chosen = relevant_and_diverse(
            state.scores, state.visual_features, state.visual_alive, count, key_count, self.relevant_share
        )
        return state.keep_visual(chosen)


SIMILARITY = ("efficientvla", "similarity")
_INPUT = ("efficientvla", "input")


class LayerSimilarity(TokenPruner):
    """Pruner that drops nothing and writes each layer's input-output similarity: ``("efficientvla", "similarity")``, f32 [B,
    L].

    It is the cosine between a token before and after the layer, mean over tokens. That of the first layer is not measured: 0.
    """

    out_keys = [SIMILARITY]

    def bind(self, spec: VisualSpec) -> None:
        self._num_layers = spec.num_layers

    def begin(self, td: TensorDictBase) -> None:
        td.set(SIMILARITY, torch.zeros(*td.batch_size, self._num_layers, device=td.device))

    def after_layer(self, index: int, state: LayerState) -> None:
        if index:
            alike = functional.cosine_similarity(state.td.get(_INPUT).float(), state.hidden.float(), dim=-1)
            alive = state.alive.float()
            state.td.get(SIMILARITY)[:, index] = (alike * alive).sum(-1) / alive.sum(-1)
        state.td.set(_INPUT, state.hidden)


def redundant_layers(similarity: Tensor, count: int) -> list[int]:
    """Return the ``count`` layers that change their input least; the first two are never among them.

    Args:
        similarity: f32 [Q, L], what `LayerSimilarity` says of Q policy calls of the dense policy.
        count: layers to skip.

    Raises:
        InputError: if there are not so many.

    Examples:
        >>> redundant_layers(torch.tensor([[0.0, 0.9, 0.3, 0.8, 0.5]]), 2)
        [3, 4]
    """
    mean = similarity.mean(0)
    free = len(mean) - EfficientVLAPruner._LAYER - 1
    if not 0 <= count <= free:
        raise InputError(f"skipped: expected 0 to {free} layers, got {count}")
    order = mean[-free:].argsort(descending=True, stable=True)[:count] + len(mean) - free
    return sorted(order.tolist())
