"""What a method that prunes visual tokens sees of a vision-language-action model, and what it may answer.

There are two ways to prune, and both leave the model's code alone:

* *Before the decoder.* Whoever runs earlier writes ``("tokens", "keep_mask")``, bool [*B, N], True = kept. The N visual tokens
  are camera-major: all patches of the primary camera, row by row, then all of the wrist camera.
* *Between decoder layers.* ``vla.pruner`` is a `TokenPruner` (None: dense), called once per query like this::

      pruner.bind(spec)                            # once, when assigned: sizes to check budgets against
      pruner.begin(td)                             # td: TensorDict [B], the query
      for layer in range(num_layers):
          rows = pruner.score_rows(state)          # only where layer is in pruner.layers_scored(num_layers)
          ...                                      # the decoder layer, with fused attention everywhere
          keep = pruner.after_layer(layer, state)  # bool [B, S] or None
      pruner.end(td)

**State.** A pruner keeps nothing in itself. ``td`` is flat, [B], holds the policy's and the pruner's ``in_keys`` (as far as the
environment has them; images are cropped as the network sees them, so that patch and token agree), and is the same object in
`begin`, in ``state.td`` and in `end`: what must survive from one layer to the next is written there under any name. What is
in the pruner's ``out_keys`` at `end` goes back to the environment, everything else is dropped. So what must outlive a query,
such as ``("tokens", "score")`` or the previous frame, is an out_key and an in_key; it is missing at the first query of all, and
rows with ``"is_init"`` start afresh. A pruner may write ``("tokens", "keep_mask")`` in `begin`; the model reads it afterwards.

**Guarantees of the model.** BOS, proprio, text, action and stop tokens survive whatever a mask says. Tokens keep their
original positions. Rows may keep different tokens: they are gathered to the front, padded to the longest row, and padding is
masked out of attention (``state.alive``), so that a row's actions do not depend on the rest of its batch. Keeping everything is
bit-exactly the dense model.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["LayerState", "TokenKind", "TokenPruner", "VisualSpec"]


class TokenKind(IntEnum):
    """What a token of the decoder's sequence is, in the order of the sequence (methods of OpenVLA-OFT, arXiv:2502.19645)."""

    BOS = 0
    PRIMARY = 1
    WRIST = 2
    PROPRIO = 3
    TEXT = 4
    ACTION = 5
    STOP = 6


@dataclass(frozen=True)
class VisualSpec:
    """The sizes of a model that a pruner has to know.

    Attributes:
        num_layers: decoder layers L.
        cameras: keys of the images, in the order of their tokens.
        grid: rows and columns of patches of one image.
        image_size: height and width of an image in pixels.

    Examples:
        >>> spec = VisualSpec(32, (("observation", "image"), ("observation", "wrist_image")), (16, 16), 224)
        >>> spec.per_camera, spec.num_visual, [view.start for view in spec.views]
        (256, 512, [0, 256])
    """

    num_layers: int
    cameras: tuple[NestedKey, ...]
    grid: tuple[int, int]
    image_size: int

    @property
    def per_camera(self) -> int:
        """Visual tokens of one camera."""
        return self.grid[0] * self.grid[1]

    @property
    def num_visual(self) -> int:
        """Visual tokens N of all cameras."""
        return len(self.cameras) * self.per_camera

    @property
    def views(self) -> list[slice]:
        """The visual token ids of each camera."""
        return [slice(i * self.per_camera, (i + 1) * self.per_camera) for i in range(len(self.cameras))]


@dataclass
class LayerState:
    """The decoder's sequence around one layer; S is its present length, N the number of visual tokens before any pruning.

    In `TokenPruner.score_rows` it shows the input of the layer, in `TokenPruner.after_layer` its output.

    Attributes:
        layer: index of the decoder layer, from 0.
        hidden: [B, S, d], the residual stream.
        alive: bool [B, S]; False is padding of rows that are shorter than the longest.
        positions: i64 [B, S], original positions; among the alive tokens of a row they ascend.
        kind: i64 [B, S], `TokenKind`.
        task: bool [B, S]; the words of the instruction itself, without the prompt around them.
        num_visual: N.
        td: the query, [B], see the module.
        scores: f32 [B, N], indexed by visual token id: attention of the rows from `TokenPruner.score_rows` to each visual
            token, mean over heads and over those rows (SpecPrune-VLA, arXiv:2509.05614, Eq. 1); 0 for tokens that are gone.
            None where the layer is not scored, and in `score_rows`.
        attention: f32 [B, R, N], the same before the mean over rows, in the order of the sequence; rows of a sample that has
            fewer than R are 0. None where ``scores`` is.
    """

    layer: int
    hidden: Tensor
    alive: Tensor
    positions: Tensor
    kind: Tensor
    task: Tensor
    num_visual: int
    td: TensorDictBase
    scores: Tensor | None = None
    attention: Tensor | None = None

    @property
    def is_visual(self) -> Tensor:
        """bool [B, S]: alive visual tokens."""
        return self.alive & ((self.kind == TokenKind.PRIMARY) | (self.kind == TokenKind.WRIST))

    @property
    def visual_ids(self) -> Tensor:
        """i64 [B, S]: ids 0..N-1 of visual tokens; meaningless elsewhere, see `is_visual`."""
        return self.positions - 1

    @property
    def visual_alive(self) -> Tensor:
        """bool [B, N]: which visual tokens are still there."""
        ids = torch.where(self.is_visual, self.visual_ids, self.num_visual)
        alive = ids.new_zeros(ids.shape[0], self.num_visual + 1, dtype=torch.bool)
        return alive.scatter(1, ids, True)[:, :-1]

    def keep_visual(self, keep: Tensor) -> Tensor:
        """The answer of `TokenPruner.after_layer`, bool [B, S], that keeps the visual tokens in ``keep``, bool [B, N]."""
        ids = self.visual_ids.clamp(0, self.num_visual - 1)
        return keep.gather(1, ids) | ~self.is_visual


class TokenPruner:
    """Base of everything that prunes visual tokens between decoder layers; this one keeps all. See the module for the protocol.

    Attributes:
        in_keys: what `begin` reads beside what the policy reads; keys that the environment lacks are left out.
        out_keys: what `end` leaves in its TensorDict for the environment; all of them, at every query.

    Examples:
        >>> class KeepHalf(TokenPruner):
        ...     def layers_scored(self, num_layers):
        ...         return {1}
        ...
        ...     def after_layer(self, index, state):
        ...         if index != 1:
        ...             return None
        ...         best = state.scores.topk(state.num_visual // 2).indices
        ...         return state.keep_visual(torch.zeros_like(state.scores, dtype=torch.bool).scatter(1, best, True))
        >>> sorted(KeepHalf().layers_scored(4))
        [1]
    """

    in_keys: list[NestedKey] = []
    out_keys: list[NestedKey] = []

    def bind(self, spec: VisualSpec) -> None:
        """Called when the pruner is assigned to a policy.

        Raises:
            ValueError: if the pruner does not fit the model, for instance a budget larger than its tokens.
        """

    def layers_scored(self, num_layers: int) -> set[int]:
        """Decoder layers that compute ``state.scores``; each costs a softmax of the chosen rows over all tokens."""
        return set()

    def layers_skipped(self, num_layers: int) -> set[int]:
        """Decoder layers that are not run at all, as the identity; `after_layer` is not called for them."""
        return set()

    def begin(self, td: TensorDictBase) -> None:
        """Before the decoder, with the query's inputs in ``td`` [B]."""

    def score_rows(self, state: LayerState) -> Tensor:
        """bool [B, S]: whose attention is the score in this layer; by default that of the instruction's words."""
        return state.task

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        """bool [B, S], True = kept, or None to keep all. Only visual tokens can be dropped."""
        return None

    def end(self, td: TensorDictBase) -> None:
        """After the decoder: writes ``out_keys`` into ``td``."""
