"""Selection of one chunk among several samples of a policy call.

Bidirectional Decoding (arXiv:2408.17355) samples several chunks and keeps one that agrees with the decision before. Its
backward coherence is the distance to what the last chunk still has for the same steps, later ones counting less::

    L_B(a) = sum_i rho^i |a_i - last[elapsed + i]|          over the steps i that both chunks have

Its forward contrast compares with samples of a weaker policy; what can be had without one is the agreement of the samples among
themselves, the mean distance to the others, whose smallest is their medoid.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError

__all__ = ["CoherentChunk", "backward_coherence", "disagreement"]


def backward_coherence(candidates: Tensor, last: Tensor, elapsed: Tensor, decay: float) -> Tensor:
    """Return L_B of every candidate, f32 [B, S]; 0 if there is no previous chunk or none of it is left.

    Args:
        candidates: chunks f32 [B, S, n, A].
        last: the chunk before f32 [B, n, A].
        elapsed: steps since that, i64 [B, 1]; 0 where there is none.
        decay: rho, in (0, 1].

    >>> candidates = torch.tensor([[[[0.0], [0.0]], [[2.0], [0.0]]]])
    >>> backward_coherence(candidates, torch.tensor([[[9.0], [2.0]]]), torch.tensor([[1]]), 0.5).tolist()
    [[2.0, 0.0]]
    """
    step = torch.arange(candidates.shape[-2], device=candidates.device)
    index = elapsed + step
    shared = (index < last.shape[-2]) & (elapsed > 0)
    index = index.clamp(max=last.shape[-2] - 1)[..., None].expand(*index.shape, last.shape[-1])
    distance = (candidates - last.gather(-2, index)[:, None]).norm(dim=-1)
    return (distance * (shared * decay**step)[:, None]).sum(dim=-1)


def disagreement(candidates: Tensor) -> Tensor:
    """Return the mean distance of every candidate to the others, f32 [B, S], for chunks f32 [B, S, n, A].

    >>> disagreement(torch.tensor([[[[0.0]], [[1.0]], [[5.0]]]])).tolist()
    [[3.0, 2.5, 4.5]]
    """
    samples = candidates.shape[1]
    distance = (candidates[:, :, None] - candidates[:, None]).norm(dim=-1).mean(dim=-1)
    return distance.sum(dim=-1) / max(samples - 1, 1)


class CoherentChunk(TensorDictModuleBase):
    """Selector of the candidate with the smallest ``backward * L_B + agreement * disagreement``; ties go to the first.

    Reads ``("control", "candidates")`` f32 [B, S, n, A] and what `ChunkExecutor` hands over of the last chunk; writes
    ``("control", "chosen")`` i64 [B, 1]. Distances are in environment units.

    Args:
        backward, agreement: weights, >= 0.
        decay: rho of the backward coherence, in (0, 1].

    Raises:
        InputError: if a number is out of its range.
    """

    in_keys = [keys.CANDIDATES, keys.LAST_CHUNK, keys.ELAPSED]
    out_keys = [keys.CHOSEN]

    def __init__(self, backward: float = 1.0, agreement: float = 0.0, decay: float = 0.5) -> None:
        super().__init__()
        if not (backward >= 0 and agreement >= 0):
            raise InputError(f"backward, agreement: expected weights >= 0, got {backward}, {agreement}")
        if not 0 < decay <= 1:
            raise InputError(f"decay: expected a number in (0, 1], got {decay}")
        self.backward, self.agreement, self.decay = backward, agreement, decay

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        candidates = keys.read(tensordict, keys.CANDIDATES)
        loss = self.agreement * disagreement(candidates)
        if (elapsed := keys.recall(tensordict, keys.ELAPSED, (1,), 0)).any():
            last = keys.read(tensordict, keys.LAST_CHUNK)
            loss = loss + self.backward * backward_coherence(candidates, last, elapsed, self.decay)
        return tensordict.set(keys.CHOSEN, loss.argmin(dim=-1, keepdim=True))
