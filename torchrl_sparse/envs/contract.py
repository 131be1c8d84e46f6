"""The observation contract of a policy, read from its ``source``, for everything that feeds it observations.

Environments (`torchrl_sparse.envs.for_policy`), demonstrations (`torchrl_sparse.data.for_policy`) and policies that drive a
collection (`torchrl_sparse.data.dagger`) all obey the same `Contract`. What cannot be translated into it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, Task, find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.convention import Convention, source_convention

__all__ = [
    "OBJECTS",
    "Contract",
    "check_contract",
    "continued_source",
    "named_task",
    "policy_contract",
    "provenance",
    "task_contract",
]

OBJECTS = "object"
"""Name of the one observation whose meaning depends on the version of robosuite."""


@dataclass(frozen=True)
class Contract:
    """Meaning of the state entries and images that a policy observes.

    Attributes:
        task: name of the task; None for one that is not known here.
        state_keys: names of the observations whose concatenation is the state, in order.
        convention: the version of robosuite whose meaning the objects' state has.
        cameras: name of an image here -> its name in demonstrations.
    """

    task: str | None
    state_keys: tuple[str, ...]
    convention: Convention = "1.5"
    cameras: Mapping[str, str] = field(default_factory=dict)

    @property
    def meaning(self) -> str:
        """The state as text, with the convention where it matters."""
        names = ", ".join(self.state_keys)
        return f"{names} as of robosuite {self.convention}" if OBJECTS in self.state_keys else names


def task_contract(task: str, cameras: Mapping[str, str] | None = None) -> Contract:
    """Return the contract of policies trained with this library; with cameras, they do not observe the objects' state.

    Args:
        task: a name or alias.
        cameras: see `Contract`.

    >>> task_contract("lift", {"image": "agentview_image"}).state_keys
    ('robot0_eef_pos', 'robot0_eef_quat_site', 'robot0_gripper_qpos')
    """
    found = find_task(task)
    keys = found.proprioception_keys if cameras else found.state_keys
    return Contract(found.name, keys, cameras=dict(cameras or {}))


def policy_contract(task: str, policy: DiffusionPolicy) -> Contract:
    """Return what a policy observes of a task, from its ``source`` or else the default for policies trained here.

    Args:
        task: a name or alias.
        policy: any.

    Raises:
        InputError: if the policy was trained for another task, has cameras and its ``source`` does not say which, or observes
            or acts in other names, sizes or at another rate than the task's; the message names both.

    >>> policy_contract("lift", DiffusionPolicy.from_pretrained("assets/lift")).state_keys[0]
    'object'
    """
    found = find_task(task)
    trained = policy.source.get("task")
    if trained is not None and named_task(trained) not in (None, found.name):
        raise InputError(f"policy: expected one that was trained for {found.name}, got one for {trained}")
    return _shown(found, policy)


def _shown(task: Task, policy: DiffusionPolicy) -> Contract:
    _check_actions(task, policy.source)
    rate = policy.source.get("control_freq")
    if isinstance(task, RobosuiteTask) and rate not in (None, CONTROL_FREQ):
        raise InputError(
            f"policy: expected one of {CONTROL_FREQ} actions a second, as {task.name} takes, got one of {rate}"
        )
    cameras = _cameras(policy)
    own = task_contract(task.name, cameras)
    keys = tuple(policy.source.get("state_keys") or own.state_keys)
    found = (policy.normalizer.state_scale.numel(), policy.normalizer.action_scale.numel())
    expected = (_state_size(task, keys), task.action_dim)
    if found != expected:
        raise InputError(
            f"policy: expected one of {expected[0]} observed numbers and {expected[1]} of an action, for {task.name}, "
            f"got one of {found[0]} and {found[1]}"
        )
    convention = source_convention(policy.source)
    robosuite = isinstance(task, RobosuiteTask) and OBJECTS in keys
    return Contract(task.name, keys, convention if robosuite else "1.5", cameras)


def check_contract(policy: DiffusionPolicy, shown: Contract | None) -> None:
    """Raise InputError if a policy would read the observations with another meaning.

    Args:
        policy: any.
        shown: meaning of what it would be shown; None if nobody noted it.

    Raises:
        InputError: naming what its ``source`` says and what is shown; also as of `policy_contract`.
    """
    if shown is None:
        return
    if shown.task is not None:
        expected = policy_contract(shown.task, policy)
    elif keys := policy.source.get("state_keys"):
        expected = Contract(None, tuple(keys), source_convention(policy.source), _cameras(policy))
    else:
        return  # neither of both says what the numbers are
    if shown.meaning != expected.meaning:
        raise InputError(
            f"demos: expected {expected.meaning}, as the policy's source says, got {shown.meaning}"
        )
    for name, key in expected.cameras.items():
        if shown.cameras.get(name) != key:
            got = shown.cameras.get(name, "none")
            raise InputError(f"demos: {name}: expected {key}, as the policy's source says, got {got}")


def provenance(contract: Contract | None) -> dict[str, str]:
    """Return the contract's note for a file of demonstrations; empty if it is the default contract of policies trained here.

    >>> provenance(task_contract("lift")), provenance(Contract("Lift", ("object",), "1.4"))
    ({}, {'observed': 'object as of robosuite 1.4'})
    """
    if contract is None or contract.task is None:
        return {}
    own = task_contract(contract.task, contract.cameras)
    return {} if contract.meaning == own.meaning else {"observed": contract.meaning}


def continued_source(task: str, policy: DiffusionPolicy) -> dict[str, Any]:
    """Return the ``source`` of a policy after further training: its own, naming the task it was last trained on.

    Args:
        task: that it is trained on now, a name or alias.
        policy: that is trained on.

    Raises:
        InputError: as of `policy_contract`, if what it observes and commands is not the task's.

    >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
    >>> policy.source = {"weights": "model", "task": "lift_lowdim"}
    >>> continued_source("lift", policy)["task"]
    'lift_lowdim'
    """
    found, trained = find_task(task), policy.source.get("task")
    _shown(found, policy)
    elsewhere = trained is not None and named_task(trained) not in (None, found.name)
    return policy.source | ({"task": found.alias} if elsewhere else {})


def named_task(trained: str) -> str | None:
    """Return the task that a published name, such as "lift_lowdim" or "blockpush_image", stands for.

    >>> named_task("tool_hang_image_abs"), named_task("my_own")
    ('ToolHang', None)
    """
    plain = trained.lower().replace("_", "")
    names = {
        name.lower().replace("_", ""): task.name
        for task in TASKS.values()
        for name in (task.name, task.alias)
    }
    return names.get(max((name for name in names if plain.startswith(name)), key=len, default=""))


def _cameras(policy: DiffusionPolicy) -> dict[str, str]:
    if policy.vision is None:
        return {}
    named = policy.source.get("cameras") or {}
    cameras = {name: named.get(name, "") for name in policy.vision.cameras}
    if not all(cameras.values()):
        raise InputError(f"policy.source['cameras']: expected those of {list(cameras)}, got {named}")
    return cameras


def _check_actions(task: Task, source: Mapping[str, Any]) -> None:
    """Refuse an imported policy whose actions are of the other kind than the task's: their sizes may be the same."""
    absolute = source.get("abs_action")
    if absolute is None and "weights" in source and not task.acts_in_poses:
        absolute = False  # as published code takes it; a pose of a robosuite arm is known by its size
    if task.abs_action is not None and absolute is not None and absolute != task.abs_action:
        kinds = {"True": "absolute actions (abs_action true)", "False": "relative actions (abs_action false)"}
        expected, got = (kinds.get(str(kind), repr(kind)) for kind in (task.abs_action, absolute))
        raise InputError(f"policy: expected one of {expected} for {task.name}, got one of {got}")


def _state_size(task: Task, keys: tuple[str, ...]) -> int:
    if isinstance(task, RobosuiteTask):
        try:
            return task.state_size(keys)
        except ValueError as error:
            raise InputError(f"policy: {error}") from error
    if keys != task.state_keys:
        expected, got = ", ".join(task.state_keys), ", ".join(keys)
        raise InputError(f"policy: state_keys: expected {expected} for {task.name}, got {got}")
    return task.state_dim
