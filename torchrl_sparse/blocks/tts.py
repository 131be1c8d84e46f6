"""Test-time Sparsity (TTS, arXiv:2605.13316): SAG's pruner, which also says what a pruned block reuses.

The network of :mod:`torchrl_sparse.blocks.sag` with a third logit: a cell that is pruned reuses by the rule of the mask, or
recalls what the last query that computed it had there (:mod:`torchrl_sparse.blocks.engine.recall`)::

    (keep, prune, recall) = MLP([W_o obs ; z])
    M = prune > keep        R = M and recall > 0

TTS chooses among the computed output, the latest of the type, the block's own latest and the recalled one with one softmax;
here the rule is fixed for a planner, as SAG's is, and recalling is a choice of its own, so that the pruning can be trained and
weighed exactly as SAG's. The first query of an episode computes everything. For equal choices, what is answered and the
gradient of a gate are those of the release (``tests/released``). :mod:`torchrl_sparse.training.pruner.recalls` trains it.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from torchrl_sparse.blocks.recall import Recalling
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.keys import COND, ELAPSED, QUERY

__all__ = ["FORMAT", "TTSPruner"]

FORMAT = "torchrl_sparse.tts/1"


class TTSPruner(Recalling, SAGPruner):
    """Predicts from its observation what a query computes, reuses and recalls.

    Args:
        network: the trained network, with ``recalls``.
        info: what it was trained for; without a ``rate_range``.

    Raises:
        ValueError: if the network does not say what is recalled, or reads a rate.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_sparse.blocks.planner import PlanSpec
        >>> from torchrl_sparse.keys import PRUNE_MASK, RECALL
        >>> network = PrunerNetwork([3, 2, 1, 0], num_blocks=6, cond_shape=(2, 5), recalls=True)
        >>> planner = TTSPruner(network, PrunerInfo(policy="a policy", sampler="ddim", rate=0.7))
        >>> planner.bind(PlanSpec(4, 2, "a policy", sampler="ddim"))
        >>> td = planner(TensorDict({COND: torch.zeros(3, 2, 5)}, [3]))  # the first queries of their episodes
        >>> td[PRUNE_MASK].any().item(), td[RECALL].any().item()
        (False, False)
    """

    format: ClassVar[str] = FORMAT

    def __init__(self, network: PrunerNetwork, info: PrunerInfo) -> None:
        if not network.recalls or network.rate_input:
            raise ValueError(
                f"network: expected recalls=True and rate_input=False, got {network.recalls} and {network.rate_input}"
            )
        super().__init__(network, info)
        self.in_keys = [COND, ELAPSED, QUERY]

    def masks(self, cond: Tensor, query: Tensor) -> Tensor:
        """Return masks bool [B, K, 3L] for queries of these numbers, i64 [B, 1]: nothing is pruned in the first."""
        return super().masks(cond) & (query > 0)[..., None]

    @torch.no_grad()
    def recalled(self, cond: Tensor, mask: Tensor) -> Tensor:
        logits = self.network.recall_logits(cond.reshape(-1, *cond.shape[-2:]))
        return mask & (logits > 0).view_as(mask)
