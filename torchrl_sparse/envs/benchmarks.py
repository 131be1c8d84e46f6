"""The tasks outside robosuite on which Diffusion Policy (arXiv:2303.04137) reports, and finding any task by its name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.tasks import TASKS, Task, get_task

__all__ = ["BENCHMARKS", "Benchmark", "find_task"]


@dataclass(frozen=True)
class Benchmark:
    """One task of another simulator, which an optional extra brings.

    Attributes:
        name: what results call it.
        alias: folders, command lines and the module in `torchrl_sparse.envs` call it so.
        state_dim, action_dim: sizes of the published low-dimensional observation and action.
        environment: class in that module.
    """

    name: str
    alias: str
    state_dim: int
    action_dim: int
    environment: str

    @property
    def state_keys(self) -> tuple[str, ...]:
        """What demonstrations call the state."""
        return ("state",)

    @property
    def proprioception_keys(self) -> tuple[str, ...]:
        """The state of image tasks, of which this is none: a ValueError says so."""
        raise ValueError(f"cameras: expected none for {self.name}, whose policies see its state")

    @property
    def acts_in_poses(self) -> bool:
        """Whether actions are absolute poses of arms."""
        return False

    def make(self, **kwargs: Any) -> SeededEnv:
        """Its environment; see the class for ``kwargs`` and errors."""
        module = import_module(f"torchrl_sparse.envs.{self.alias}")
        return getattr(module, self.environment)(**kwargs)


BENCHMARKS = {
    task.name: task
    for task in (
        Benchmark("PushT", "pusht", 20, 2, "PushTEnv"),
        Benchmark("BlockPush", "block_push", 16, 2, "BlockPushEnv"),
        Benchmark("FrankaKitchen", "kitchen", 60, 9, "KitchenEnv"),
    )
}


def find_task(name: str) -> Task | Benchmark:
    """The task of that name or alias, in robosuite or not.

    Raises:
        ValueError: if there is none; the message lists those there are.

    >>> find_task("pusht").state_dim, find_task("can").state_dim
    (20, 23)
    """
    for task in BENCHMARKS.values():
        if name in (task.name, task.alias):
            return task
    try:
        return get_task(name)
    except ValueError as error:
        names = ", ".join([*TASKS, *BENCHMARKS])
        raise ValueError(f"task: expected one of {names} or their aliases, got {name!r}") from error
