"""Policies from files of this library, of the published code, and of LeRobot."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_sparse.blocks.engine.factory import EngineName
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.policies.diffusion.freezing import FreezablePolicy
from torchrl_sparse.policies.diffusion.warm_start import WarmStart
from torchrl_sparse.storage.diffusion import StoredPolicy, read_pretrained
from torchrl_sparse.storage.lerobot.policy import is_lerobot, read_lerobot
from torchrl_sparse.storage.published.diffusion_policy import read_diffusion_policy

if sys.version_info >= (3, 11):
    from typing import Self
else:
    from typing_extensions import Self

__all__ = ["LoadablePolicy"]


class LoadablePolicy(FreezablePolicy):
    """Part of a `DiffusionPolicy` that loads it from files."""

    @classmethod
    def from_pretrained(cls, path: str | Path, *, engine: EngineName = "auto") -> Self:
        """Read what `save_pretrained` wrote, with sampler, start and planner; a ``.ckpt`` as `from_diffusion_policy` does,
        and a folder of LeRobot's as `from_lerobot` does.

        A policy that was saved with rounded weights rounds them again under ``engine="auto"``; ``"native"`` does not.

        Raises:
            FileNotFoundError, InputError: naming the file, what was expected in it and what was found.
        """
        if is_lerobot(Path(path)):
            return cls.from_lerobot(path, engine=engine)
        stored = read_diffusion_policy(path) if Path(path).suffix == ".ckpt" else read_pretrained(Path(path))
        policy: Any = cls._assemble(stored, engine)
        if stored.plan is not None:
            policy.plan = load_planner(Path(path) / stored.plan, policy.plan.spec)
        return policy

    @classmethod
    def from_diffusion_policy(
        cls, path: str | Path, *, engine: EngineName = "auto", ignore: Collection[str] = ()
    ) -> Self:
        """Read a ``.ckpt`` of the published code (`torchrl_sparse.storage.published.diffusion_policy`, also on ``ignore``).

        Averaged weights are used unless ``use_ema`` is false; ``source`` says what it was trained for. Nothing is executed.

        Raises:
            FileNotFoundError, CheckpointError: naming the file, what was expected in it and what was found.
        """
        return cls._assemble(read_diffusion_policy(path, ignore), engine)

    @classmethod
    def from_lerobot(
        cls,
        path: str | Path,
        *,
        engine: EngineName = "auto",
        task: str | None = None,
        tokens: Mapping[str, Sequence[int]] | None = None,
    ) -> Self:
        """Read a ``multi_task_dit`` policy that LeRobot 0.6 saved (`torchrl_sparse.storage.lerobot`). Nothing is executed.

        Calls read ``"language_instruction"``, or do ``task``. Instructions become tokens by a ``tokenizer.json`` in the
        folder or in the one that its configuration names; ``tokens``, text -> ids, are for policies without.

        Raises:
            FileNotFoundError, InputError: naming the file, the entry, what was expected and what came.
        """
        return cls._assemble(read_lerobot(Path(path), task=task, tokens=tokens), engine)

    @classmethod
    def _assemble(cls, stored: StoredPolicy, engine: EngineName) -> Self:
        engine = stored.engine or engine if engine == "auto" else engine
        parts: dict[str, Any] = {"vision": stored.vision, "sampler": stored.sampler, "engine": engine}
        policy: Any = cls(stored.network, stored.normalizer, **parts)
        policy.source = stored.source
        policy.start = None if stored.warm_start is None else WarmStart(stored.warm_start)
        return policy
