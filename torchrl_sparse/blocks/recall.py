"""A planner that reuses across the queries of a rollout, as TTS (arXiv:2605.13316) does, without its training.

Every query computes its first step and each `interval`-th other one, another each time; in the steps between, all blocks return
what the last query that computed the step had there (:mod:`torchrl_sparse.blocks.engine.recall`). TTS learns, cell by cell,
whether to compute, to reuse within the query or to recall; this asks what recalling alone is worth, at the cost of
`uniform<interval>`. The first query of an episode computes everything. Only the reference engine recalls: counts of FLOPs say
what it is worth, times do not.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.keys import COND, ELAPSED, PRUNE_MASK, QUERY, RECALL, REUSE, recall

__all__ = ["Recall", "recalled_steps"]


def recalled_steps(query: Tensor, num_steps: int, interval: int) -> Tensor:
    """Return the steps that are recalled, bool [B, K]; none in the first query of an episode, nor ever the first step.

    Args:
        query: queries of the episode before this one, i64 [B, 1].

    >>> recalled_steps(torch.tensor([[0], [1], [2]]), num_steps=4, interval=2).int().tolist()
    [[0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 1]]
    """
    step = torch.arange(num_steps, device=query.device)
    return ((step + query) % interval != 0) & (step > 0) & (query > 0)


class Recall(Planner):
    """Writes which steps a query recalls, see the module.

    Reads ``("control", "elapsed")``, which `ChunkExecutor` hands to a policy that asks for it; queries that come without it,
    or without a query before them, are the first of their episode. Writes ``("diffusion", "recall")`` and
    ``("diffusion", "query")`` beside the mask.

    Args:
        interval: of the steps that are computed, >= 2.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_sparse.blocks.planner import PlanSpec
        >>> planner = Recall(2)
        >>> planner.bind(PlanSpec(num_inference_steps=4, num_layers=1, policy="a policy"))
        >>> query = {COND: torch.zeros(1, 2, 5), ELAPSED: torch.tensor([[8]]), QUERY: torch.tensor([[0]])}
        >>> td = planner(TensorDict(query, [1]))
        >>> td[RECALL][0, :, 0].int().tolist()
        [0, 0, 1, 0]
    """

    in_keys = [COND, ELAPSED, QUERY]
    out_keys = [PRUNE_MASK, REUSE, RECALL, QUERY]

    def __init__(self, interval: int) -> None:
        super().__init__()
        if interval < 2:
            raise ValueError(f"interval: expected at least 2, got {interval}")
        self.interval = interval

    @property
    def fingerprint(self) -> str:
        """A name of the interval."""
        return f"recall{self.interval}"

    def options(self, tensordict: TensorDictBase, rows: int) -> dict[str, Tensor]:
        """Return the number of every query in its episode, and write it."""
        number = recall(tensordict, QUERY, (1,), -1) + 1  # none was counted: there is nothing to recall
        number = number.masked_fill(recall(tensordict, ELAPSED, (1,), 0) == 0, 0)
        tensordict.set(QUERY, number)
        return {"query": number.reshape(rows, 1)}

    def masks(self, cond: Tensor, query: Tensor) -> Tensor:
        """Return masks bool [B, K, 3L] for queries of these numbers, i64 [B, 1]."""
        steps = recalled_steps(query, self.spec.num_inference_steps, self.interval)
        return steps[..., None].repeat(1, 1, self.spec.num_blocks)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write mask and reuse rule as any planner, and that all pruned cells are recalled."""
        tensordict = super().forward(tensordict)
        return tensordict.set(RECALL, tensordict.get(PRUNE_MASK).clone())
