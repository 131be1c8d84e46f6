"""Similarity of a block's output to everything that a pruned block could reuse in its place.

Three rules are published. BAC (arXiv:2506.13456) reuses the block's own output of an earlier denoising step. SAG
(arXiv:2601.12894, "one-for-all") reuses the latest output of any block of its type: that of the layer before in the same step,
and for the first layer that of the last layer in the step before. TTS (arXiv:2605.13316) also reuses the output of the same
block in the same step of the policy call before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import cosine_similarity

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["ReuseSources", "reuse_sources", "source_similarity"]


@dataclass(frozen=True)
class ReuseSources:
    """Cosine similarity of each block's output to each reuse source, mean over policy calls; ``[3L][K]`` each.

    Attributes:
        queries: that were asked, densely.
        own: its output one denoising step before; step 0 is not a number and given as 0.
        type: the latest output of its type; in step 0 the first layer has none, and 0.
        query: its output in the same step of the call before, over the calls that have one before them.
    """

    queries: int
    own: list[list[float]]
    type: list[list[float]]
    query: list[list[float]]


def source_similarity(features: Tensor, before: Tensor | None = None) -> Tensor:
    """Return f32 [3, 3L, K], similarity to the sources ``own``, ``type`` and ``query``, 0 where there is none.

    Args:
        features: of a policy call, f32 [3L, K, n], flattened outputs.
        before: of the call before.

    >>> features = torch.tensor([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 1.0]], [[1.0, 1.0], [0.0, 1.0]]])
    >>> (100 * source_similarity(features)[0]).round().int().tolist()
    [[0, 100], [0, 71], [0, 71]]
    """
    kinds = len(BLOCK_TYPES)
    own, latest = torch.zeros_like(features), torch.zeros_like(features)
    own[:, 1:] = features[:, :-1]
    latest[kinds:] = features[:-kinds]
    latest[:kinds, 1:] = features[-kinds:, :-1]
    sources = own, latest, torch.zeros_like(features) if before is None else before
    return torch.stack([cosine_similarity(features, source, dim=-1) for source in sources])


@torch.no_grad()
def reuse_sources(policy: DiffusionPolicy, queries: TensorDictBase) -> ReuseSources:
    """Run recorded policy calls densely and compare the outputs of their blocks.

    Args:
        policy: the trained policy with its sampler; its planner does not matter.
        queries: [N], of `torchrl_sparse.control.queries.record_queries`, episode by episode.

    Raises:
        InputError: if no call has another before it.
    """
    encoded = policy.module["encode"](queries.select(*policy.in_keys, strict=False))
    noise = policy.sample_noise(encoded[keys.SEED].flatten())
    elapsed = queries[keys.ELAPSED].flatten().tolist()
    if not any(elapsed):
        raise InputError("queries: expected some with a policy call of their episode before them, got none")
    total, before = 0, None
    for row in range(len(queries)):
        recorder = FeatureRecorder()
        rows = slice(row, row + 1)
        denoise(policy.network, policy.sampler, noise[rows], encoded[keys.COND][rows], record=recorder)
        features = recorder.features().flatten(2)
        total = total + source_similarity(features, before if elapsed[row] else None)
        before = features
    counts = torch.tensor([len(queries), len(queries), sum(map(bool, elapsed))])
    own, latest, query = (total.cpu() / counts[:, None, None]).tolist()
    return ReuseSources(len(queries), own, latest, query)
