"""Base of all methods that prune visual tokens, and the two ways to prune them.

* *Before the decoder.* Whoever runs earlier writes ``("tokens", "keep_mask")``, bool [*B, N], True = kept; a pruner may do so
  in `TokenPruner.begin`.
* *Between decoder layers.* ``vla.pruner`` is a `TokenPruner` (None is dense), which each policy call calls like this::

      pruner.bind(spec)     # once, when assigned: sizes to check budgets against
      pruner.begin(td)      # td: TensorDict [B], the call
      ...                   # the decoder's layers, see `torchrl_sparse.networks.vla.hooks`
      pruner.end(td)

**State.** A pruner keeps nothing in itself. ``td`` is flat, [B], holds the policy's and the pruner's ``in_keys`` (as far as the
environment has them; images are cropped as the network sees them, so that patch and token agree), and is the same object in
`begin`, in ``state.td`` and in `end`: what must survive from one layer to the next is written there under any name. What is
in the pruner's ``out_keys`` at `end` goes back to the environment, everything else is dropped. So state that outlives a call,
such as ``("tokens", "score")`` or the previous frame, is both an out_key and an in_key, and `TokenPruner.carried` gives its
spec to an environment; it is missing or 0 at the first call of all, and rows with ``"is_init"`` start afresh.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry
from torchrl_sparse.networks.vla.hooks import LayerHooks, VisualSpec

__all__ = ["TokenPruner"]


class TokenPruner(LayerHooks):
    """Base of all visual-token pruners; it keeps all tokens. See the module for the order of calls.

    Attributes:
        in_keys: what `begin` reads beside what the policy reads; keys that the environment lacks are left out.
        out_keys: what `end` leaves in its TensorDict for the environment; all of them, at every policy call.
        look_back: calls that its images reach back.

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
    look_back: int = 1
    spec: VisualSpec

    def bind(self, spec: VisualSpec) -> None:
        """Prepare for the model on assignment; pruners that carry keys keep its sizes as ``self.spec``.

        Raises:
            InputError: if the pruner does not fit it, for instance a budget larger than its tokens.
        """

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the keys carried for one environment, see :mod:`torchrl_sparse.carried`; pruners add their own.

        These are images and scores of the last policy call. What it leaves out follows any environment but a bare
        `ParallelEnv`.
        """
        both = set(self.in_keys) & set(self.out_keys)
        if not both:
            return {}
        spec = self.spec
        frames = (len(spec.cameras), 3, spec.image_size, spec.image_size)
        known = {
            keys.TOKEN_FRAMES: Entry(frames, torch.uint8),
            keys.TOKEN_PAST_FRAMES: Entry((self.look_back - 1, *frames), torch.uint8),
            keys.TOKEN_SCORE: Entry((spec.num_visual,)),
        }
        return {key: entry for key, entry in known.items() if key in both}

    def begin(self, td: TensorDictBase) -> None:
        """Prepare a policy call before the decoder runs, from its inputs in ``td`` [B]."""

    def end(self, td: TensorDictBase) -> None:
        """Write ``out_keys`` into ``td`` after the decoder."""
