"""Frame differencing alone, one ingredient of SpecPrune-VLA: keep what changed since the last call, drop the rest."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.frames import FRAME_KEYS, compare_frames
from torchrl_sparse.tokens.selection import best_per_camera, check_share


def most_changed(similarity: Tensor, count: int, cameras: int) -> Tensor:
    """Choose the ``count`` patches of each camera least similar to their predecessors, bool [B, N].

    Args:
        similarity: [B, N], see `torchrl_sparse.tokens.frames.similarity`.

    Examples:
        >>> import torch
        >>> most_changed(torch.tensor([[0.9, 0.2, 1.0, 0.8]]), 1, cameras=2).tolist()
        [[False, True, False, True]]
    """
    return best_per_camera(-similarity, [count] * cameras, similarity.isfinite())


class FrameDifferencePruner(TokenPruner):
    """Pruner that keeps each camera's ``share`` of patches that changed most since the last call; all at an episode's first.

    It prunes before the decoder, so that no layer is scored.

    Args:
        share: of each camera's tokens that stay, in (0, 1].
    """

    in_keys = FRAME_KEYS
    out_keys = [keys.KEEP_MASK, keys.TOKEN_FRAMES]

    def __init__(self, share: float = 0.5):
        check_share("share", share)
        self.share = share

    def bind(self, spec: VisualSpec) -> None:
        self.spec = spec

    def begin(self, td: TensorDictBase) -> None:
        alike, first = compare_frames(td, self.spec)
        count = round(self.share * self.spec.per_camera)
        td.set(keys.KEEP_MASK, first | most_changed(alike, count, len(self.spec.cameras)))
