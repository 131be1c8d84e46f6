"""Temporal ensembling: a policy whose chunks are averaged with earlier predictions for the same steps.

ACT (arXiv:2304.13705, temporal ensembling) asks at every step and plays the weighted mean of all predictions for it, the oldest
with index 0 and the largest weight::

    a_t = sum_i w_i a_t^(i) / sum_i w_i          w_i = exp(-coeff i)

Here it is kept as a running mean, so one chunk and a count are all that a call needs of those before it::

    mean_{k+1} = (W_k mean_k + w_k a_t^(k)) / W_{k+1},     W_k = sum_{i<k} w_i

How often the policy is asked is the executor's (`ChunkExecutor.n_action_steps`): with chunks of n actions, asked every m steps,
up to ceil(n / m) predictions meet. The averaged actions are those that the environment gets; a mean of rotations' first two
columns is made orthonormal where the environment reads it. Predictions that disagree, such as two ways past an obstacle, are
averaged too.
"""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.warm_start import shift_chunk

__all__ = ["TemporalEnsemble"]


class TemporalEnsemble(TensorDictModuleBase):
    """Policy whose chunks are averaged over its policy calls; see the module.

    Reads ``("control", "last_chunk")`` and ``("control", "elapsed")``, which `ChunkExecutor` hands over, and
    ``("control", "ensembled")``, which it wrote at the call before: the predictions in each action of that chunk. An episode's
    first chunk is the policy's own.

    Args:
        policy: writes ``("vla_action", "chunk")``, f32 [*B, n, A], always of the same n.
        coeff: of the weights above; 0 is the plain mean, positive favours old predictions, negative new ones. ACT's is 0.01.

    Raises:
        InputError: if ``coeff`` is not finite.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> policy = TensorDictModule(lambda x: x[:, None].expand(-1, 3, 1), in_keys=["x"], out_keys=[keys.CHUNK])
        >>> ensemble = TemporalEnsemble(policy, coeff=0.0)
        >>> query = TensorDict({"x": torch.zeros(1, 1), "control": {"elapsed": torch.tensor([[0]])}}, [1])
        >>> first = ensemble(query)
        >>> later = {"last_chunk": first[keys.CHUNK], "ensembled": first[keys.ENSEMBLED], "elapsed": torch.tensor([[1]])}
        >>> ensemble(TensorDict({"x": torch.ones(1, 1), "control": later}, [1]))[keys.CHUNK].flatten().tolist()
        [0.5, 0.5, 1.0]
    """

    def __init__(self, policy: TensorDictModuleBase, coeff: float = 0.01):
        super().__init__()
        if not math.isfinite(coeff):
            raise InputError(f"coeff: expected a finite number, got {coeff}")
        self.policy, self.coeff = policy, coeff
        self.in_keys = list(dict.fromkeys([*policy.in_keys, keys.LAST_CHUNK, keys.ELAPSED, keys.ENSEMBLED]))
        self.out_keys = [*policy.out_keys, keys.ENSEMBLED]

    @property
    def chunk_shape(self) -> tuple[int, int] | None:
        """(n, A) of a chunk, None if the policy does not define it."""
        return getattr(self.policy, "chunk_shape", None)

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the keys carried for one environment, see :mod:`torchrl_sparse.carried`."""
        return {} if chunk is None else {keys.ENSEMBLED: Entry(chunk.shape[:1], torch.int64)}

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        elapsed = keys.recall(tensordict, keys.ELAPSED, (1,), 0)
        answer = self.policy(tensordict)
        chunk = answer.get(keys.CHUNK)
        earlier = torch.zeros(chunk.shape[:-1], dtype=torch.int64, device=chunk.device)
        if elapsed.any():
            earlier = _still_to_come(keys.read(tensordict, keys.ENSEMBLED), elapsed)
            before = shift_chunk(keys.read(tensordict, keys.LAST_CHUNK), elapsed, chunk.shape[-2])
            chunk = self._mean(before, chunk, earlier)
        answer.set(keys.CHUNK, chunk)
        return answer.set(keys.ENSEMBLED, earlier + 1)

    def _mean(self, before: Tensor, chunk: Tensor, earlier: Tensor) -> Tensor:
        """Return the mean of chunks [*B, n, A], where ``before`` is one of ``earlier`` [*B, n] predictions."""
        weight = torch.exp(
            -self.coeff * torch.arange(int(earlier.max()) + 1, device=chunk.device, dtype=chunk.dtype)
        )
        total = weight.cumsum(dim=0)
        # Of the newest prediction: 1 where it is the only one, or where its weight is past all numbers.
        share = (weight / total).nan_to_num(nan=1.0)[earlier][..., None]
        return torch.where(share < 1, before + share * (chunk - before), chunk)


def _still_to_come(count: Tensor, elapsed: Tensor) -> Tensor:
    """Return the predictions i64 [*B, n] that the last chunk, of ``count`` each, has for the steps of one asked now."""
    index = elapsed + torch.arange(count.shape[-1], device=count.device)
    known = (index < count.shape[-1]) & (elapsed > 0)
    return count.gather(-1, index.clamp(max=count.shape[-1] - 1)) * known
