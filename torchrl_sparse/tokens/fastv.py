"""FastV (Chen et al., arXiv:2403.06764): after a few layers, keep the visual tokens that the last token attends to."""

from __future__ import annotations

from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import LayerState, TokenKind, VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.selection import best, check_share


def last_text_token(kind: Tensor, alive: Tensor) -> Tensor:
    """Return the last token of each row's prompt, bool [B, S].

    Args:
        kind: i64 [B, S], `TokenKind`.
        alive: bool [B, S].

    Examples:
        >>> import torch
        >>> kind = torch.tensor([[0, 1, 4, 4, 5]])
        >>> last_text_token(kind, torch.ones_like(kind, dtype=torch.bool)).int().tolist()
        [[0, 0, 0, 1, 0]]
    """
    text = alive & (kind == TokenKind.TEXT)
    return text & (text.cumsum(-1) == text.sum(-1, keepdim=True))


class FastVPruner(TokenPruner):
    """Pruner that drops visual tokens once, after ``layer`` layers, by the last prompt token's attention in the layer before.

    FastV's last token is the one that predicts the first output; with parallel action slots that is the last of the prompt.

    Args:
        share: of all visual tokens that stay (the paper's 1 - R), in (0, 1].
        layer: layers that see every token (the paper's K).
        depth: of the decoder that ``layer`` is meant for, 32 in the paper: it is scaled to the model's depth, at least 1. None
            takes it as it is.
    """

    def __init__(self, share: float = 0.5, layer: int = 2, depth: int | None = None):
        check_share("share", share)
        if layer < 1:
            raise InputError(f"layer: expected at least 1, got {layer}")
        self.share = share
        self.layer, self.depth = layer, depth

    def bind(self, spec: VisualSpec) -> None:
        if (layer := self._scaled(spec.num_layers)) >= spec.num_layers:
            raise InputError(f"layer: expected less than the model's {spec.num_layers} layers, got {layer}")

    def _scaled(self, num_layers: int) -> int:
        return self.layer if self.depth is None else max(1, round(self.layer * num_layers / self.depth))

    def layers_scored(self, num_layers: int) -> set[int]:
        return {self._scaled(num_layers) - 1}

    def layers_watched(self, num_layers: int) -> set[int]:
        return set()

    def score_rows(self, state: LayerState) -> Tensor:
        return last_text_token(state.kind, state.alive)

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        if state.scores is None:
            return None
        count = round(self.share * state.num_visual)
        return state.keep_visual(best(state.scores, count, state.visual_alive))
