"""The robosuite tasks: what each is called, observes and allows.

Layouts follow the low-dimensional tasks of Diffusion Policy (arXiv:2303.04137): the task's object state first, then position,
quaternion and finger positions of each arm. The quaternion is read from the grip *site*, the frame that absolute actions
command; robosuite's ``robot0_eef_quat`` is another frame, about 90 degrees off.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """One robosuite task.

    Attributes:
        name: robosuite's name, or ours for a variant (`torchrl_sparse.envs.moving_lift`, `torchrl_sparse.envs.named_lift`).
        alias: robomimic's short name; folders and command lines use it.
        arms: number of Panda arms.
        object_dim: size of robosuite's ``object-state``.
        horizon: steps after which an episode is truncated, as in Diffusion Policy's evaluation (20 Hz).
        instructions: the task in words; where there are several, each episode asks for one of them.
    """

    name: str
    alias: str
    arms: int
    object_dim: int
    horizon: int
    instructions: tuple[str, ...]

    @property
    def has_choice(self) -> bool:
        """Whether episodes differ in what they ask for."""
        return len(self.instructions) > 1

    def check_instruction(self, words: str) -> None:
        """Raises ValueError unless ``words`` are one of `instructions`."""
        if words not in self.instructions:
            expected = ", ".join(map(repr, self.instructions))
            raise ValueError(f"instruction: expected one of {expected} for {self.name}, got {words!r}")

    @property
    def state_keys(self) -> tuple[str, ...]:
        """robosuite observations whose concatenation is the state."""
        return ("object", *self.proprioception_keys)

    @property
    def proprioception_keys(self) -> tuple[str, ...]:
        """Those of the arms: the state of image tasks, where cameras show the objects."""
        return tuple(f"robot{i}_{name}" for i in range(self.arms) for name in _PROPRIOCEPTION)

    @property
    def acts_in_poses(self) -> bool:
        """Whether actions are absolute poses of arms."""
        return True

    @property
    def state_dim(self) -> int:
        return self.object_dim + self.arms * sum(_PROPRIOCEPTION.values())

    def state_slice(self, key: str) -> slice:
        """Where one of `state_keys` lies in the state."""
        sizes = [self.object_dim, *self.arms * tuple(_PROPRIOCEPTION.values())]
        index = self.state_keys.index(key)
        return slice(sum(sizes[:index]), sum(sizes[: index + 1]))


_PROPRIOCEPTION = {"eef_pos": 3, "eef_quat_site": 4, "gripper_qpos": 2}

TASKS = {
    task.name: task
    for task in (
        Task("Lift", "lift", 1, 10, 400, ("lift the red cube",)),
        Task("LiftMoving", "lift_moving", 1, 10, 400, ("lift the moving red cube",)),
        Task(
            "LiftNamed",
            "lift_named",
            1,
            10,
            200,
            tuple(f"lift the {c} cube" for c in ("red", "green", "blue")),
        ),
        Task("PickPlaceCan", "can", 1, 14, 400, ("put the can into its bin",)),
        Task("NutAssemblySquare", "square", 1, 14, 400, ("put the square nut on the square peg",)),
        Task(
            "TwoArmTransport",
            "transport",
            2,
            41,
            700,
            ("hand the hammer over and put it into the target bin",),
        ),
        Task("ToolHang", "tool_hang", 1, 44, 700, ("assemble the frame and hang the tool on it",)),
    )
}


def get_task(name: str) -> Task:
    """The task of that robosuite name or alias.

    Raises:
        ValueError: if there is none; the message lists those there are.
    """
    for task in TASKS.values():
        if name in (task.name, task.alias):
            return task
    raise ValueError(f"task: expected one of {', '.join(TASKS)} or their aliases, got {name!r}")
