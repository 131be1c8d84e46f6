"""SparseVLM (arXiv:2410.04417): image-relevant words rate visual tokens; the better of the dropped ones are merged.

Zhang et al., ICML 2025. How many tokens go is adaptive: the more independent directions the raters' attention has (its rank),
the fewer. A merged token takes the place, and the position, of the token at the centre of its cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import LayerState, TokenKind
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.selection import check_share, scaled_layers

_DEPTH = 32
_RATERS = ("sparsevlm", "raters")


def text_raters(hidden: Tensor, is_visual: Tensor, is_text: Tensor) -> Tensor:
    """Choose the words relevant to the image, bool [B, S]: more similar to the visual tokens than the mean word.

    Args:
        hidden: [B, S, d].
        is_visual, is_text: bool [B, S]; each row has a text token.

    Examples:
        >>> hidden = torch.tensor([[[1.0, 0.0], [4.0, 0.0], [0.0, 4.0]]])
        >>> text_raters(hidden, torch.tensor([[True, False, False]]), torch.tensor([[False, True, True]])).tolist()
        [[False, True, False]]
    """
    alike = hidden.float() @ hidden.float().transpose(-1, -2)
    relevance = alike.masked_fill(~is_text[:, None], -torch.inf).softmax(-1)
    relevance = (relevance * is_visual[..., None]).sum(1)
    mean = relevance.sum(-1, keepdim=True) / is_text.sum(-1, keepdim=True)
    return is_text & (relevance >= mean)


def dropped_counts(attention: Tensor, alive: Tensor, scale: float) -> Tensor:
    """Count the visual tokens to drop in each row, i64 [B]: ``scale`` times those beyond the raters' attention rank.

    Args:
        attention: [B, raters, N], 0 for dead tokens.
        alive: bool [B, N].
    """
    beyond = alive.sum(-1) - torch.linalg.matrix_rank(attention.float())
    return (scale * beyond.clamp_min(0)).long()


def density_peaks(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Cluster around points that are dense and far from any denser one (Rodriguez and Laio, 2014).

    Args:
        points: [n, d].
        count: clusters, 1 to n.

    Returns:
        Indices of the centres, i64 [count], and the cluster of each point, i64 [n].

    Examples:
        >>> points = torch.tensor([[0.0], [0.1], [0.2], [5.0], [5.1], [5.2]])
        >>> density_peaks(points, 2)[1].tolist() in ([0, 0, 0, 1, 1, 1], [1, 1, 1, 0, 0, 0])
        True
    """
    distance = torch.cdist(points, points) / points.shape[-1] ** 0.5
    neighbours = min(max(count, 2), len(points))  # a point is its own nearest
    density = (-distance.topk(neighbours, largest=False).values.square().mean(-1)).exp()
    order = density.argsort(descending=True, stable=True)
    place = torch.empty_like(order).scatter(0, order, torch.arange(len(points), device=points.device))
    denser = place[None] < place[:, None]
    isolation = distance.masked_fill(~denser, torch.inf).amin(-1).clamp(max=distance.max())
    centres = (isolation * density).argsort(descending=True, stable=True)[:count]
    cluster = distance[:, centres].argmin(-1)
    cluster[centres] = torch.arange(count, device=points.device)
    return centres, cluster


def merge(points: Tensor, cluster: Tensor, count: int) -> Tensor:
    """Return the mean [count, d] of each cluster of ``points`` [n, d]."""
    member = torch.nn.functional.one_hot(cluster, count).to(points.dtype)
    return (member.T @ points) / member.sum(0)[:, None]


def _raters(state: LayerState) -> Tensor:
    text = state.alive & (state.kind == TokenKind.TEXT)
    return text_raters(state.hidden, state.is_visual, text)


class SparseVLMPruner(TokenPruner):
    """Pruner that drops and recycles visual tokens in several layers.

    Args:
        scale: share of the tokens beyond the rank that go in each layer (the paper's lambda), in (0, 1].
        layers: after which to prune, in a decoder 32 deep; scaled to the model's depth.
        recycled: share of the dropped tokens, the best, that are merged.
        clusters: merged tokens, as a share of those.
        raters: which words rate: ``"layer"`` chooses them again in each of the ``layers``, from what reaches it;
            ``"embeddings"``, as the authors' release, once and before the decoder.

    Raises:
        InputError: for a share outside (0, 1], or other raters.
    """

    def __init__(
        self,
        scale: float = 0.3,
        layers: Sequence[int] = (2, 6, 15),
        recycled: float = 0.3,
        clusters: float = 0.1,
        raters: Literal["layer", "embeddings"] = "layer",
    ):
        if raters not in ("layer", "embeddings"):
            raise InputError(f"raters: expected 'layer' or 'embeddings', got {raters!r}")
        for name, value in {"scale": scale, "recycled": recycled, "clusters": clusters}.items():
            check_share(name, value)
        self.scale, self.recycled, self.clusters = scale, recycled, clusters
        self.layers, self.raters = tuple(layers), raters

    def layers_scored(self, num_layers: int) -> set[int]:
        return set(scaled_layers(self.layers, _DEPTH, num_layers))

    def layers_watched(self, num_layers: int) -> set[int]:
        return set()

    def before_layers(self, state: LayerState) -> None:
        if self.raters == "embeddings":  # kept by position, as the sequence becomes shorter
            chosen = state.alive.new_zeros(len(state.alive), int(state.positions.max()) + 1)
            state.td.set(_RATERS, chosen.scatter(1, state.positions, _raters(state) & state.alive))

    def score_rows(self, state: LayerState) -> Tensor:
        if self.raters == "embeddings":
            return state.td.get(_RATERS).gather(1, state.positions) & state.alive
        return _raters(state)

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        if state.scores is None:
            return None
        counts = dropped_counts(state.attention, state.visual_alive, self.scale)
        keep, hidden = torch.ones_like(state.alive), state.hidden.clone()
        # Row by row, since each drops another number of tokens.
        for row, count in enumerate(counts.tolist()):
            slots = state.is_visual[row].nonzero().squeeze(-1)
            best_first = state.scores[row, state.visual_ids[row, slots]].argsort(descending=True, stable=True)
            dropped = slots[best_first[len(slots) - count :]]
            keep[row, dropped] = False
            if count:
                self._recycle(hidden[row], keep[row], dropped)
        state.hidden = hidden
        return keep

    def _recycle(self, hidden: Tensor, keep: Tensor, dropped: Tensor) -> None:
        """Merge the first of the ``dropped`` slots, in place, into the slots of some of them."""
        slots = dropped[: max(1, round(self.recycled * len(dropped)))]
        count = max(1, round(self.clusters * len(slots)))
        points = hidden[slots].float()
        centres, cluster = density_peaks(points, count)
        hidden[slots[centres]] = merge(points, cluster, count).to(hidden.dtype)
        keep[slots[centres]] = True
