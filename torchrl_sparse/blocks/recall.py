"""Planners that reuse across the queries of a rollout, as TTS (arXiv:2605.13316) does, without its training.

TTS learns, cell by cell, whether to compute, to reuse within the query or to recall what the last query that computed the cell
had there (:mod:`torchrl_sparse.blocks.engine.recall`). `Recall` asks what recalling alone is worth, at the cost of
`uniform<interval>`: every query computes its first step and each `interval`-th other one, another each time, and recalls the
rest. `RecallSchedule` has a choice for each cell, the same in every query, which
:mod:`torchrl_sparse.training.diffusion.recall_choice` searches. The first query of an episode computes everything. All
engines but PyTorch's recall. A schedule is a JSON file that people can read::

    {
      "format": "torchrl_sparse.recall/1",
      "policy": "<fingerprint of the policy that it was made for>",
      "sampler": "ddpm",
      "num_inference_steps": 10,
      "num_layers": 8,
      "reuse": "type",
      "settings": {"attempts": 300},
      "cells": {
        "layers.0.SA": "CC--R-R--C",
        ...
      }
    }

A letter for each step in execution order: C computes, - reuses by the rule, R recalls.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse.blocks.engine.recall import check_recall
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, block_name, check_reuse, validate_mask
from torchrl_sparse.blocks.planner import Planner, PlanSpec
from torchrl_sparse.keys import COND, ELAPSED, PRUNE_MASK, QUERY, RECALL, REUSE, recall
from torchrl_sparse.networks.diffusion.naming import SamplerName
from torchrl_sparse.networks.diffusion.sampler import MAX_TRAIN_TIMESTEPS
from torchrl_sparse.networks.diffusion.transformer import MAX_LAYERS
from torchrl_sparse.networks.sizes import check_size
from torchrl_sparse.storage.json import read_json, write_json

__all__ = ["FORMAT", "Recall", "RecallSchedule", "Recalling", "recalled_steps"]

FORMAT = "torchrl_sparse.recall/1"

_COMPUTED, _REUSED, _RECALLED = "C-R"


def recalled_steps(query: Tensor, num_steps: int, interval: int) -> Tensor:
    """Return the steps that are recalled, bool [B, K]; none in the first query of an episode, nor ever the first step.

    Args:
        query: queries of the episode before this one, i64 [B, 1].

    >>> recalled_steps(torch.tensor([[0], [1], [2]]), num_steps=4, interval=2).int().tolist()
    [[0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 1]]
    """
    step = torch.arange(num_steps, device=query.device)
    return ((step + query) % interval != 0) & (step > 0) & (query > 0)


class Recalling(Planner):
    """Base of planners that recall: counts the queries of an episode, which `masks` gets the numbers of.

    Reads ``("control", "elapsed")``, which `ChunkExecutor` hands to a policy that asks for it; queries that come without it,
    or without a query before them, are the first of their episode. Writes ``("diffusion", "recall")`` and
    ``("diffusion", "query")`` beside the mask. A subclass writes :meth:`recalled`, unless all that is pruned is recalled.
    """

    in_keys = [COND, ELAPSED, QUERY]
    out_keys = [PRUNE_MASK, REUSE, RECALL, QUERY]

    def options(self, tensordict: TensorDictBase, rows: int) -> dict[str, Tensor]:
        """Return the number of every query in its episode, and write it."""
        number = recall(tensordict, QUERY, (1,), -1) + 1  # none was counted: there is nothing to recall
        number = number.masked_fill(recall(tensordict, ELAPSED, (1,), 0) == 0, 0)
        tensordict.set(QUERY, number)
        return {"query": number.reshape(rows, 1)}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write mask and reuse rule as any planner, and which pruned cells are recalled."""
        tensordict = super().forward(tensordict)
        return tensordict.set(RECALL, self.recalled(tensordict.get(COND), tensordict.get(PRUNE_MASK)))

    def recalled(self, cond: Tensor, mask: Tensor) -> Tensor:
        """Return the cells of ``mask`` that are recalled, both bool [*B, K, 3L], for ``cond`` f32 [*B, To, D]."""
        return mask.clone()


class Recall(Recalling):
    """Writes which steps a query recalls, see the module.

    Args:
        interval: of the steps that are computed, >= 2.

    Examples:
        >>> from tensordict import TensorDict
        >>> planner = Recall(2)
        >>> planner.bind(PlanSpec(num_inference_steps=4, num_layers=1, policy="a policy"))
        >>> query = {COND: torch.zeros(1, 2, 5), ELAPSED: torch.tensor([[8]]), QUERY: torch.tensor([[0]])}
        >>> td = planner(TensorDict(query, [1]))
        >>> td[RECALL][0, :, 0].int().tolist()
        [0, 0, 1, 0]
    """

    def __init__(self, interval: int) -> None:
        super().__init__()
        if interval < 2:
            raise ValueError(f"interval: expected at least 2, got {interval}")
        self.interval = interval

    @property
    def fingerprint(self) -> str:
        """A name of the interval."""
        return f"recall{self.interval}"

    def masks(self, cond: Tensor, query: Tensor) -> Tensor:
        """Return masks bool [B, K, 3L] for queries of these numbers, i64 [B, 1]."""
        steps = recalled_steps(query, self.spec.num_inference_steps, self.interval)
        return steps[..., None].repeat(1, 1, self.spec.num_blocks)


class RecallSchedule(Recalling):
    """Computes, reuses or recalls each cell as it was chosen, in every query of an episode but the first; see the module.

    Args:
        mask: bool [K, 3L], True = pruned.
        recalled: bool [K, 3L], those of them that are recalled.
        made_for: policy and sampler.
        reuse: what the others reuse.
        settings: how it was made; what JSON holds, for people.

    Raises:
        ValueError: if the mask is none of that sampler, or a cell is recalled that is not pruned.

    Examples:
        >>> mask = torch.tensor([[False] * 3, [True] * 3])
        >>> recalled = torch.tensor([[False] * 3, [False, False, True]])
        >>> planner = RecallSchedule(mask, recalled, PlanSpec(2, 1, "a policy"))
        >>> planner.cells()
        {'layers.0.SA': 'C-', 'layers.0.CA': 'C-', 'layers.0.FFN': 'CR'}
    """

    def __init__(
        self,
        mask: Tensor,
        recalled: Tensor,
        made_for: PlanSpec,
        reuse: Reuse = "block",
        settings: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        validate_mask(mask, made_for.num_inference_steps, made_for.num_layers, batch=())
        check_recall(recalled, mask)
        check_reuse(reuse)
        self.made_for, self.reuse, self.settings = made_for, reuse, settings or {}
        self.register_buffer("mask", mask.clone())
        self.register_buffer("chosen", recalled.clone())

    def masks(self, cond: Tensor, query: Tensor) -> Tensor:
        """Return masks bool [B, K, 3L] for queries of these numbers, i64 [B, 1]: nothing is pruned in the first."""
        return self.mask & (query > 0)[..., None]

    def recalled(self, cond: Tensor, mask: Tensor) -> Tensor:
        return mask & self.chosen

    def cells(self) -> dict[str, str]:
        """Return what is done with each block, a letter for each step."""
        letters = torch.where(self.mask, torch.where(self.chosen, 2, 1), 0).T.tolist()
        kinds = _COMPUTED + _REUSED + _RECALLED
        return {
            block_name(column): "".join(kinds[one] for one in block) for column, block in enumerate(letters)
        }

    def save_pretrained(self, path: str | os.PathLike) -> None:
        """Write the file under a temporary name and move it into place."""
        spec = self.made_for
        sizes = spec.num_inference_steps, spec.num_layers
        made = self.reuse, self.settings, self.cells()
        write_json(path, _RecallFile(FORMAT, spec.policy, spec.sampler, *sizes, *made))

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike) -> RecallSchedule:
        """Read and check a file; nothing in it is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: naming the file, what was expected and what came, if it is no valid schedule.
        """
        return read_json(path, _RecallFile).schedule()


@dataclass(frozen=True)
class _RecallFile:
    """The content of a schedule's file."""

    format: Literal["torchrl_sparse.recall/1"]
    policy: str
    sampler: str
    num_inference_steps: int
    num_layers: int
    reuse: Reuse
    settings: dict[str, Any]
    cells: dict[str, str]

    def __post_init__(self) -> None:
        """Raise ValueError, which `read_json` puts the file before, if blocks or letters are not those of the network."""
        check_size("num_inference_steps", self.num_inference_steps, MAX_TRAIN_TIMESTEPS)
        check_size("num_layers", self.num_layers, MAX_LAYERS)
        SamplerName.parse(self.sampler)
        steps = self.num_inference_steps
        names = [block_name(column) for column in range(len(BLOCK_TYPES) * self.num_layers)]
        if [*self.cells] != names:
            raise ValueError(
                f"cells: expected {names[0]} to {names[-1]}, got {', '.join(self.cells) or 'none'}"
            )
        for name, letters in self.cells.items():
            if len(letters) != steps or set(letters) - {_COMPUTED, _REUSED, _RECALLED}:
                raise ValueError(f"cells of {name}: expected {steps} letters of C, - and R, got {letters!r}")
        self.schedule()  # which refuses what is pruned in the first step

    def schedule(self) -> RecallSchedule:
        """Return the schedule."""
        spec = PlanSpec(self.num_inference_steps, self.num_layers, self.policy, self.sampler)
        blocks = self.cells.values()
        mask, recalled = (
            torch.tensor([[letter in kinds for letter in letters] for letters in blocks]).T
            for kinds in ((_REUSED, _RECALLED), (_RECALLED,))
        )
        return RecallSchedule(mask, recalled, spec, self.reuse, self.settings)
