"""The interface between a vision-language-action model's decoder and methods that read or prune its tokens.

The decoder calls one `LayerHooks` object around every layer::

    hooks.before_layers(state)                   # once, of the embeddings
    for layer in range(num_layers):              # but those in hooks.layers_skipped(num_layers)
        rows = hooks.score_rows(state)           # only where layer is in hooks.layers_scored(num_layers)
        ...                                      # the decoder layer, with fused attention everywhere
        keep = hooks.after_layer(layer, state)   # only where layer is watched or scored; bool [B, S] or None

**Guarantees of the model.** BOS, proprio, text, action and stop tokens survive whatever a mask says. Tokens keep their
original positions. Rows may keep different tokens: they are gathered to the front, padded to the longest row, and padding is
masked out of attention (``state.alive``), so that a row's actions do not depend on the rest of its batch. Keeping everything is
bit-exactly the dense model.

The N visual tokens are camera-major: all patches of the primary camera, row by row, then all of the wrist camera.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["LayerHooks", "LayerState", "TokenKind", "VisualSpec"]


class TokenKind(IntEnum):
    """Token types of the decoder's sequence, in order (methods of OpenVLA-OFT, arXiv:2502.19645)."""

    BOS = 0
    PRIMARY = 1
    WRIST = 2
    PROPRIO = 3
    TEXT = 4
    ACTION = 5
    STOP = 6


@dataclass(frozen=True)
class VisualSpec:
    """Sizes of a model that determine its visual tokens.

    Attributes:
        num_layers: decoder layers L.
        cameras: keys of the images, in the order of their tokens.
        grid: rows and columns of patches of one image.
        image_size: height and width of an image in pixels.
        width: numbers of a token in the decoder, d.

    Examples:
        >>> spec = VisualSpec(32, (("observation", "image"), ("observation", "wrist_image")), (16, 16), 224, 4096)
        >>> spec.per_camera, spec.num_visual, [view.start for view in spec.views]
        (256, 512, [0, 256])
    """

    num_layers: int
    cameras: tuple[NestedKey, ...]
    grid: tuple[int, int]
    image_size: int
    width: int

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
        """Visual token ids of each camera."""
        return [slice(i * self.per_camera, (i + 1) * self.per_camera) for i in range(len(self.cameras))]


@dataclass
class LayerState:
    """The decoder's sequence around one layer; S is its current length, N the number of visual tokens before any pruning.

    `LayerHooks.score_rows` is given the input of the layer, `LayerHooks.after_layer` its output, and what is known of
    which tokens are visual is computed once for both: of a state only ``hidden`` may be exchanged.

    Attributes:
        layer: index of the decoder layer, from 0.
        hidden: [B, S, d], the residual stream.
        alive: bool [B, S]; False is padding of rows that are shorter than the longest.
        positions: i64 [B, S], original positions; among the alive tokens of a row they ascend.
        kind: i64 [B, S], `TokenKind`.
        task: bool [B, S]; the words of the instruction itself, without the prompt around them.
        num_visual: N.
        td: the policy call, [B].
        scores: f32 [B, N], indexed by visual token id: attention of the rows from `LayerHooks.score_rows` to each visual
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

    @cached_property
    def is_visual(self) -> Tensor:
        """bool [B, S]: alive visual tokens."""
        return self.alive & ((self.kind == TokenKind.PRIMARY) | (self.kind == TokenKind.WRIST))

    @property
    def visual_ids(self) -> Tensor:
        """i64 [B, S]: ids 0..N-1 of visual tokens; meaningless elsewhere, see `is_visual`."""
        return self.positions - 1

    @cached_property
    def visual_alive(self) -> Tensor:
        """bool [B, N]: visual tokens that have not been dropped."""
        ids = torch.where(self.is_visual, self.visual_ids, self.num_visual)
        alive = ids.new_zeros(ids.shape[0], self.num_visual + 1, dtype=torch.bool)
        return alive.scatter(1, ids, True)[:, :-1]

    @property
    def visual_features(self) -> Tensor:
        """[B, N, d]: the residual stream at each visual token; 0 for dropped ones."""
        ids = torch.where(self.is_visual, self.visual_ids, self.num_visual)[..., None]
        width = self.hidden.shape[-1]
        features = self.hidden.new_zeros(len(ids), self.num_visual + 1, width)
        return features.scatter(1, ids.expand(-1, -1, width), self.hidden)[:, :-1]

    def keep_visual(self, keep: Tensor) -> Tensor:
        """Return a keep mask for `LayerHooks.after_layer`, bool [B, S], from visual tokens ``keep``, bool [B, N]."""
        ids = self.visual_ids.clamp(0, self.num_visual - 1)
        return keep.gather(1, ids) | ~self.is_visual


class LayerHooks:
    """Base of objects that the decoder calls around its layers; the base changes nothing, so the model stays dense."""

    def layers_scored(self, num_layers: int) -> set[int]:
        """Return the decoder layers that compute ``state.scores``; each costs a softmax of the scored rows over all tokens."""
        return set()

    def layers_skipped(self, num_layers: int) -> set[int]:
        """Return the decoder layers replaced by the identity; `after_layer` is not called for them."""
        return set()

    def layers_watched(self, num_layers: int) -> Set[int]:
        """Return the decoder layers behind which `after_layer` is called besides the scored ones.

        All of them where a method defines `after_layer` and does not say. Layers between two that are watched or scored
        run as one, so that naming few makes an engine faster.
        """
        defined = type(self).after_layer is not LayerHooks.after_layer
        return set(range(num_layers)) if defined else set()

    def before_layers(self, state: LayerState) -> None:
        """Inspect the sequence before the first layer; ``hidden`` holds the embeddings."""

    def score_rows(self, state: LayerState) -> Tensor:
        """Return the tokens whose attention is scored in this layer, bool [B, S]; by default the instruction's words."""
        return state.task

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        """Return the tokens to keep, bool [B, S], or None to keep all. Only visual tokens can be dropped."""
        return None
