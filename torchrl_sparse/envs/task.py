"""The protocol of a task, independent of its simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from torchrl.envs import EnvBase

__all__ = ["Task"]


class Task(Protocol):
    """Protocol of a task, implemented by `RobosuiteTask` and `StateTask`.

    Attributes:
        name: of the task in results.
        alias: short name for folders and command lines.
        graded: whether episodes are judged by their score, the highest reward of a step, since success is rare and says
            little.
        early_cut: steps within which a policy of the expert's speed is done; None where that was not measured.
        state_dim, action_dim: sizes of the low-dimensional observation and of the action.
        state_keys: names, in demonstration files, of the observations whose concatenation is the state.
        proprioception_keys: those of them that remain where cameras show the objects; ValueError for a task without cameras.
        abs_action: whether actions say where to go (True) or how far (False), where published policies do either; else None.
        acts_in_poses: whether actions are absolute poses of arms.
        demonstrator: class whose instances act out one demonstration, see `torchrl_sparse.envs.experts.demonstrators`.
    """

    @property
    def name(self) -> str: ...

    @property
    def alias(self) -> str: ...

    @property
    def graded(self) -> bool: ...

    @property
    def early_cut(self) -> int | None: ...

    @property
    def abs_action(self) -> bool | None: ...

    @property
    def state_dim(self) -> int: ...

    @property
    def action_dim(self) -> int: ...

    @property
    def state_keys(self) -> tuple[str, ...]: ...

    @property
    def proprioception_keys(self) -> tuple[str, ...]: ...

    @property
    def acts_in_poses(self) -> bool: ...

    @property
    def demonstrator(self) -> type[Any]: ...

    def make(self, **kwargs: Any) -> EnvBase:
        """Make the task's environment; see its class for ``kwargs`` and errors."""

    def load_way_of(self) -> Callable[[np.ndarray], int]:
        """Import the function that returns an episode's mode from its states, f32 [T, Ds], as the environment does.

        Raises:
            InputError: if the task's episodes tell none.
        """

    def load_expert(self) -> type[Any]:
        """Import the class of the task's scripted expert.

        Raises:
            InputError: if there is none; the message lists the tasks that have one.
        """
