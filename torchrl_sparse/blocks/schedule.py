"""Cache schedules: masks that do not depend on the observation, stored as small human-readable JSON files.

::

    {
      "format": "torchrl_sparse.schedule/1",
      "method": "bac",
      "policy": "<fingerprint of the policy that it was made for>",
      "sampler": "ddpm",
      "num_inference_steps": 100,
      "num_layers": 8,
      "reuse": "block",
      "settings": {"num_updates": 10, "top_k": 5},
      "computed_steps": {
        "layers.0.SA": [0, 7, 31, 99],
        ...
      }
    }

``computed_steps`` lists, for every block in column order, the denoising steps (in execution order) that
compute it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

from torch import Tensor

from torchrl_sparse.blocks.mask import (
    ALL_BLOCK_TYPES,
    BLOCK_TYPES,
    Reuse,
    block_name,
    check_reuse,
    mask_from_steps,
    steps_from_mask,
    validate_mask,
)
from torchrl_sparse.blocks.planner import PlanSpec, StaticPlanner
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.naming import SamplerName
from torchrl_sparse.networks.diffusion.sampler import MAX_TRAIN_TIMESTEPS
from torchrl_sparse.networks.diffusion.transformer import MAX_LAYERS
from torchrl_sparse.networks.sizes import check_size
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import read_json

__all__ = ["CacheSchedule", "SchedulePlanner"]

FORMAT = "torchrl_sparse.schedule/1"


@dataclass(frozen=True)
class _ScheduleFile:
    """The content of a schedule's file."""

    format: Literal["torchrl_sparse.schedule/1"]
    method: str
    policy: str
    sampler: str
    num_inference_steps: int
    num_layers: int
    reuse: Reuse
    settings: dict[str, Any]
    computed_steps: dict[str, list[int]]

    def schedule(self) -> CacheSchedule:
        """Return the schedule; InputError if its blocks are not those of the network."""
        steps = self.computed_steps
        types = next((types for types in ALL_BLOCK_TYPES if block_name(1, types) in steps), BLOCK_TYPES)
        names = [block_name(column, types) for column in range(len(steps))]
        if missing := [name for name in names if name not in steps]:
            raise InputError(f"computed_steps: expected {', '.join(names)}; missing {missing}")
        return CacheSchedule(
            self.method,
            self.policy,
            self.num_inference_steps,
            self.num_layers,
            tuple(tuple(steps[name]) for name in names),
            self.sampler,
            self.reuse,
            self.settings,
            types,
        )


@dataclass(frozen=True)
class CacheSchedule:
    """Blocks to compute at each denoising step, and the policy for which they were chosen.

    Attributes:
        method: name of the method that made it, e.g. ``"bac"``.
        policy: fingerprint of the policy that it was made for.
        num_inference_steps: denoising steps K.
        num_layers: layers L.
        computed_steps: for each of the blocks in column order, its computed steps: increasing, starting
            with 0.
        sampler: name of the sampler that it was made for, see `Sampler.name`.
        reuse: what its pruned blocks reuse, see :mod:`torchrl_sparse.blocks.mask`.
        settings: how it was made; numbers, strings, lists and the like, for people and reports.
        block_types: blocks of a layer, as its network has them.

    Raises:
        InputError: if a field does not hold what is described here.

    Examples:
        >>> schedule = CacheSchedule("by hand", "a policy", 4, 1, computed_steps=((0, 2), (0,), (0, 1, 3)))
        >>> schedule.mask().int().tolist()
        [[0, 0, 0], [1, 1, 0], [0, 1, 1], [1, 1, 0]]
    """

    method: str
    policy: str
    num_inference_steps: int
    num_layers: int
    computed_steps: tuple[tuple[int, ...], ...]
    sampler: str = "ddpm"
    reuse: Reuse = "block"
    settings: dict[str, Any] = field(default_factory=dict)
    block_types: tuple[str, ...] = BLOCK_TYPES

    def __post_init__(self) -> None:
        for name in ("method", "policy"):
            if not getattr(self, name):
                raise InputError(f"{name}: expected a non-empty string, got {getattr(self, name)!r}")
        check_size("num_inference_steps", self.num_inference_steps, MAX_TRAIN_TIMESTEPS)
        check_size("num_layers", self.num_layers, MAX_LAYERS)
        SamplerName.parse(self.sampler)
        check_reuse(self.reuse)
        types = len(self.block_types)
        if len(self.computed_steps) != types * self.num_layers:
            raise InputError(
                f"computed_steps: expected {types * self.num_layers} blocks ({types} * num_layers), "
                f"got {len(self.computed_steps)}"
            )
        for column, steps in enumerate(self.computed_steps):
            _check_steps(block_name(column, self.block_types), steps, self.num_inference_steps)
        object.__setattr__(self, "computed_steps", tuple(tuple(steps) for steps in self.computed_steps))

    @classmethod
    def from_mask(
        cls,
        mask: Tensor,
        *,
        method: str,
        policy: str,
        sampler: str = "ddpm",
        reuse: Reuse = "block",
        settings: dict[str, Any] | None = None,
        block_types: tuple[str, ...] = BLOCK_TYPES,
    ) -> CacheSchedule:
        """Make the schedule of a mask bool [K, 3L], or of as many as ``block_types`` in each layer.

        Raises:
            InputError: if ``mask`` is no prune mask.
        """
        num_steps, num_blocks = mask.shape if mask.ndim == 2 else (1, 0)
        num_layers = max(1, num_blocks // len(block_types))
        validate_mask(mask, num_steps, num_layers, (), block_types)
        steps = steps_from_mask(mask)
        return cls(method, policy, num_steps, num_layers, steps, sampler, reuse, settings or {}, block_types)

    @property
    def spec(self) -> PlanSpec:
        """The policy and the sampler that the schedule was made for."""
        return PlanSpec(
            self.num_inference_steps, self.num_layers, self.policy, self.sampler, self.block_types
        )

    def mask(self) -> Tensor:
        """Return the prune mask bool [K, 3L]."""
        return mask_from_steps(self.computed_steps, self.num_inference_steps)

    def save_pretrained(self, path: str | os.PathLike) -> None:
        """Write the file atomically: no reader ever sees half of it.

        Raises:
            TypeError: if ``settings`` holds something that JSON cannot.
        """
        text = self._to_json()
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike) -> CacheSchedule:
        """Read and check a schedule file; nothing in it is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            InputError: naming file and field, what was expected and what came, if it is no valid schedule.
        """
        stored = read_json(path, _ScheduleFile)
        try:
            return stored.schedule()
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error

    def _to_json(self) -> str:
        """Return JSON with one line per block, which the standard library's indentation cannot do."""
        head = {
            "format": FORMAT,
            "method": self.method,
            "policy": self.policy,
            "sampler": self.sampler,
            "num_inference_steps": self.num_inference_steps,
            "num_layers": self.num_layers,
            "reuse": self.reuse,
            "settings": self.settings,
        }
        lines = [f"  {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
        blocks = [
            f"    {json.dumps(block_name(column, self.block_types))}: {json.dumps(steps)}"
            for column, steps in enumerate(self.computed_steps)
        ]
        return "\n".join(["{", *lines, '  "computed_steps": {', ",\n".join(blocks), "  }", "}", ""])


class SchedulePlanner(StaticPlanner):
    """Planner that writes the mask of a schedule for every observation; serves only the policy that it was made for.

    Args:
        schedule: the schedule.

    Examples:
        >>> schedule = CacheSchedule("by hand", "a policy", 4, 1, computed_steps=((0, 2), (0,), (0, 1, 3)))
        >>> SchedulePlanner(schedule).bind(PlanSpec(num_inference_steps=4, num_layers=1, policy="another"))
        Traceback (most recent call last):
        ...
        torchrl_sparse.errors.InputError: SchedulePlanner: made for policy fingerprint 'a policy', got 'another'
    """

    def __init__(self, schedule: CacheSchedule) -> None:
        super().__init__()
        self.schedule, self.reuse, self.made_for = schedule, schedule.reuse, schedule.spec

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike) -> SchedulePlanner:
        """Read a schedule file; errors are those of :meth:`CacheSchedule.from_pretrained`."""
        return cls(CacheSchedule.from_pretrained(path))

    def save_pretrained(self, path: str | os.PathLike) -> None:
        """Write the schedule file, see :meth:`CacheSchedule.save_pretrained`."""
        self.schedule.save_pretrained(path)

    def mask(self, spec: PlanSpec) -> Tensor:
        """Return the schedule's mask [K, 3L]."""
        return self.schedule.mask()


def _check_steps(name: str, steps: Sequence[int], num_steps: int) -> None:
    within = all(0 <= step < num_steps for step in steps)
    if not steps or steps[0] != 0 or not within or any(a >= b for a, b in pairwise(steps)):
        raise InputError(
            f"computed_steps of {name}: expected increasing whole numbers in 0..{num_steps - 1} "
            f"that start with 0, got {list(steps)}"
        )
