"""Table of all tasks by name, `TASKS`, whose entries are each a `Task`.

A new task is a file with its environment, and one entry here or, from outside, ``TASKS[task.name] = task``. Simulators and
experts are named as ``"module:attribute"`` and imported when one is made: optional extras cost nothing before.

Layouts of robosuite's tasks follow Diffusion Policy's low-dimensional ones (arXiv:2303.04137): the objects' state, then each
arm's position, quaternion and finger positions. The quaternion is that of the grip *site*, the frame that absolute actions
command; robosuite's ``robot0_eef_quat`` is another frame, about 90 degrees off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from torchrl.envs import EnvBase

from torchrl_sparse.envs.task import Task
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import ABSOLUTE_DIM

__all__ = ["TASKS", "RobosuiteTask", "StateTask", "Task", "find_robosuite_task", "find_task"]


class _Named:
    """Load the expert that a task names."""

    name: str
    expert: str | None
    early_cut: int | None = None
    graded: bool = False
    way_of: str | None = None

    def load_way_of(self) -> Callable[[np.ndarray], int]:
        """See `Task.load_way_of`."""
        if self.way_of is None:
            raise InputError(f"task: expected one that tells its ways, got {self.name!r}, which does not")
        return _load(self.way_of)

    def load_expert(self) -> type[Any]:
        """See `Task.load_expert`."""
        if self.expert is None:
            having = ", ".join(name for name, task in TASKS.items() if getattr(task, "expert", None))
            raise InputError(f"task: expected one with an expert ({having}), got {self.name!r}")
        return _load(self.expert)


@dataclass(frozen=True)
class RobosuiteTask(_Named):
    """A robosuite task with Panda arms and absolute pose actions; a `Task`.

    Attributes:
        name: robosuite's name, or ours for a variant.
        alias: robomimic's short name.
        arms: number of Panda arms.
        object_dim: size of robosuite's ``object-state``.
        horizon: steps after which an episode is truncated, as in Diffusion Policy's evaluation (20 Hz).
        instructions: the task in words; where there are several, each episode asks for one of them.
        module: importing it registers the task with robosuite; None for robosuite's own.
        expert: ``"module:class"`` of the scripted expert, see `torchrl_sparse.envs.experts.base.Expert`; None without one.
        early_cut, way_of: see `Task`; ``way_of`` is named as ``"module:function"``.
    """

    acts_in_poses: ClassVar[bool] = True
    abs_action: ClassVar[bool] = True

    name: str
    alias: str
    arms: int
    object_dim: int
    horizon: int
    instructions: tuple[str, ...]
    module: str | None = None
    expert: str | None = None
    early_cut: int | None = None
    way_of: str | None = None

    @property
    def has_choice(self) -> bool:
        """True if episodes differ in their instruction."""
        return len(self.instructions) > 1

    def check_instruction(self, words: str) -> None:
        """Raise InputError unless ``words`` is one of `instructions`."""
        if words not in self.instructions:
            expected = ", ".join(map(repr, self.instructions))
            raise InputError(f"instruction: expected one of {expected} for {self.name}, got {words!r}")

    @property
    def state_keys(self) -> tuple[str, ...]:
        """Names of the robosuite observations whose concatenation is the state."""
        return ("object", *self.proprioception_keys)

    @property
    def proprioception_keys(self) -> tuple[str, ...]:
        """Names of the arms' observations: the state of image tasks, where cameras show the objects."""
        return tuple(f"robot{i}_{name}" for i in range(self.arms) for name in _PROPRIOCEPTION)

    @property
    def state_dim(self) -> int:
        return self.object_dim + self.arms * sum(_PROPRIOCEPTION.values())

    @property
    def action_dim(self) -> int:
        return ABSOLUTE_DIM * self.arms

    @property
    def demonstrator(self) -> type[Any]:
        return _load(f"{_EXPERTS}.demonstrators:RobosuiteDemonstrator")

    def pose_slices(self, state_keys: Sequence[str] | None = None) -> list[tuple[slice, slice]]:
        """Slices of the state that hold each arm's position and quaternion (xyzw); see `state_slice`."""
        place = partial(self.state_slice, state_keys=state_keys)
        return [(place(f"robot{i}_eef_pos"), place(f"robot{i}_eef_quat_site")) for i in range(self.arms)]

    def state_slice(self, key: str, state_keys: Sequence[str] | None = None) -> slice:
        """Return an observation's slice of a state with `state_keys`; None means the task's own."""
        names = state_keys or self.state_keys
        end = self.state_size(names[: names.index(key) + 1])
        return slice(end - self.state_size([key]), end)

    def state_size(self, state_keys: Sequence[str]) -> int:
        """Return the total size of the observations; ValueError for an unknown or repeated name."""
        arms = {f"robot{i}_{name}": size for i in range(self.arms) for name, size in _OBSERVED.items()}
        sizes = {"object": self.object_dim, **arms}
        if not state_keys or not set(state_keys) <= sizes.keys() or len({*state_keys}) < len(state_keys):
            got = ", ".join(state_keys) or "none"
            raise InputError(f"state_keys: expected some of {', '.join(sizes)} for {self.name}, got {got}")
        return sum(sizes[key] for key in state_keys)

    def make(self, **kwargs: Any) -> EnvBase:
        """Make the task's `torchrl_sparse.envs.robosuite.RobosuiteEnv`."""
        return _load(f"{_ENVS}.robosuite:RobosuiteEnv")(self.name, **kwargs)

    def register(self) -> None:
        """Register the task with robosuite, unless it is one of robosuite's own."""
        if self.module is not None:
            import_module(self.module)


@dataclass(frozen=True)
class StateTask(_Named):
    """A `Task` of another simulator (an optional extra), whose policies observe the simulator's state.

    Attributes:
        name, alias: of the task in results, and a short one.
        state_dim, action_dim: sizes of the published low-dimensional observation and action.
        environment: ``"module:class"`` of the environment.
        expert: ``"module:class"`` of the scripted expert, see `torchrl_sparse.envs.experts.demonstrators.StateExpert`; None
            without one.
        early_cut, graded, abs_action: see `Task`.
        way_of: see `RobosuiteTask`.
    """

    name: str
    alias: str
    state_dim: int
    action_dim: int
    environment: str
    expert: str | None = None
    early_cut: int | None = None
    way_of: str | None = None
    graded: bool = False
    abs_action: bool | None = None

    @property
    def state_keys(self) -> tuple[str, ...]:
        """Name of the state in demonstration files."""
        return ("state",)

    @property
    def proprioception_keys(self) -> tuple[str, ...]:
        """Raise InputError: these tasks have no cameras to show the rest of the state."""
        raise InputError(f"cameras: expected none for {self.name}, whose policies see its state")

    @property
    def acts_in_poses(self) -> bool:
        """Always False."""
        return False

    @property
    def demonstrator(self) -> type[Any]:
        """See `Task`."""
        return _load(f"{_EXPERTS}.demonstrators:StateDemonstrator")

    def make(self, **kwargs: Any) -> EnvBase:
        """Make the task's environment; see its class for ``kwargs`` and errors."""
        return _load(self.environment)(**kwargs)


def _load(path: str) -> Any:
    module, attribute = path.split(":")
    return getattr(import_module(module), attribute)


_ENVS, _EXPERTS = "torchrl_sparse.envs", "torchrl_sparse.envs.experts"
_PROPRIOCEPTION = {"eef_pos": 3, "eef_quat_site": 4, "gripper_qpos": 2}
_OBSERVED = _PROPRIOCEPTION | {"eef_quat": 4}  # of the hand's body, which published policies observe


def _expert(place: str) -> str:
    return f"{_EXPERTS}.{place}"


_LIFT = _expert("lift:LiftExpert")
_CUBES = tuple(f"lift the {colour} cube" for colour in ("red", "green", "blue", "yellow", "purple"))
# early_cut: 1.25 times the 90th percentile of the steps of 100 scripted episodes, rounded up, before any table that uses it: by
# `recipes/collect_demos.py task=TASK episodes=100 seed=10000 keep_failures=true` (35, 121.1, 140, all solved; Lift's two ways
# 49, 98 solved; 2026-11-22 and 23), of the 200 demonstrations of transport (384) and Can's two ways (115), 600 of blocks (118).
# Of moving, named and crowded Lift and its four ways (60.2, 38, 40, 47; 2026-11-28, by the command) after their first tables.
_ROBOSUITE = (
    RobosuiteTask("Lift", "lift", 1, 10, 400, ("lift the red cube",), expert=_LIFT, early_cut=44),
    RobosuiteTask(
        *("LiftMoving", "lift_moving", 1, 10, 400, ("lift the moving red cube",)),
        module=f"{_ENVS}.moving_lift",
        expert=_expert("lift:LiftMovingExpert"),
        early_cut=76,
    ),
    RobosuiteTask("LiftNamed", "lift_named", 1, 10, 200, _CUBES[:3], f"{_ENVS}.named_lift", _LIFT, 48),
    RobosuiteTask(
        *("LiftCrowded", "lift_crowded", 1, 10, 200, _CUBES),
        *(f"{_ENVS}.crowded_lift", _LIFT, 50),
    ),
    *(
        RobosuiteTask(
            *(name, alias, 1, 10, 400, ("lift the red cube around the ball",), f"{_ENVS}.lift_ways"),
            *(_expert("lift:LiftWaysExpert"), cut, f"{_ENVS}.lift_ways:way_of_{number}"),
        )
        for name, alias, number, cut in (
            ("LiftTwoWays", "lift_two_ways", "two", 62),
            ("LiftFourWays", "lift_four_ways", "four", 59),
        )
    ),
    RobosuiteTask(
        *("PickPlaceCan", "can", 1, 14, 400, ("put the can into its bin",)),
        expert=_expert("pick_place_can:PickPlaceCanExpert"),
        early_cut=152,
    ),
    RobosuiteTask(
        *("CanTwoWays", "can_two_ways", 1, 14, 400, ("put the can into its bin, around the pillar",)),
        *(f"{_ENVS}.can_ways", _expert("pick_place_can:CanWaysExpert"), 144, f"{_ENVS}.can_ways:way_of"),
    ),
    RobosuiteTask(
        *("NutAssemblySquare", "square", 1, 14, 400, ("put the square nut on the square peg",)),
        expert=_expert("nut_assembly_square:NutAssemblySquareExpert"),
        early_cut=175,
    ),
    RobosuiteTask(
        *("TwoArmTransport", "transport", 2, 41, 700),
        instructions=("hand the hammer over and put it into the target bin",),
        expert=_expert("two_arm_transport:TwoArmTransportExpert"),
        early_cut=480,
    ),
    RobosuiteTask(
        *("ToolHang", "tool_hang", 1, 44, 700, ("assemble the frame and hang the tool on it",)),
        expert=_expert("tool_hang:ToolHangExpert"),
    ),
)
_OTHERS: tuple[Task, ...] = (
    StateTask("PushT", "pusht", 20, 2, f"{_ENVS}.pusht:PushTEnv", _expert("pusht:PushTExpert"), graded=True),
    StateTask(
        *("BlockPush", "block_push", 16, 2, f"{_ENVS}.block_push:BlockPushEnv"),
        expert=_expert("block_push:BlockPushExpert"),
        early_cut=148,
        way_of=f"{_ENVS}.block_push:way_of",
        abs_action=False,
    ),
    StateTask("FrankaKitchen", "kitchen", 60, 9, f"{_ENVS}.kitchen:KitchenEnv", abs_action=True),
)

TASKS: dict[str, Task] = {task.name: task for task in (*_ROBOSUITE, *_OTHERS)}
"""Every task by its name; assign to it to add one."""


def find_task(name: str) -> Task:
    """Find a task by its name or alias; InputError if there is none.

    >>> find_task("pusht").state_dim, find_task("can").state_dim
    (20, 23)
    """
    return _find(name, [*TASKS.values()])


def find_robosuite_task(name: str) -> RobosuiteTask:
    """Find a robosuite task, as `find_task` does."""
    return _find(name, [task for task in TASKS.values() if isinstance(task, RobosuiteTask)])


def _find(name: str, tasks: Sequence[Any]) -> Any:
    for task in tasks:
        if name in (task.name, task.alias):
            return task
    names = ", ".join(task.name for task in tasks)
    raise InputError(f"task: expected one of {names} or their aliases, got {name!r}")
