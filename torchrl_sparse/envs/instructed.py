"""Environments with the images and instructions of a given vision-language-action policy: robosuite tasks and LIBERO suites."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from torchrl_sparse.envs.contract import named_task
from torchrl_sparse.envs.for_policy import camera_options
from torchrl_sparse.envs.libero import SUITES, require_libero
from torchrl_sparse.envs.libero_suite import make_suite_env
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource

__all__ = [
    "InstructedTask",
    "check_instructed",
    "continued_vla_source",
    "find_instructed_task",
    "instructed_env",
]


@dataclass(frozen=True)
class InstructedTask:
    """A task that is specified by an instruction.

    Attributes:
        name: of the task in results.
        state_dim, action_dim: numbers that a policy reads beside images, and of an action.
        early_cut, graded: see `torchrl_sparse.envs.tasks.Task`.
    """

    name: str
    state_dim: int
    action_dim: int
    early_cut: int | None = None
    graded: bool = False


def find_instructed_task(name: str) -> InstructedTask:
    """Find a robosuite task by name or alias, or a LIBERO suite.

    Raises:
        ImportError: for a suite without LIBERO, with the command that installs it.
        InputError: if there is none; the message lists those there are.

    >>> find_instructed_task("lift_named").state_dim
    9
    """
    if name in SUITES:
        require_libero()
        return InstructedTask(name, state_dim=8, action_dim=7)
    tasks = [task for task in TASKS.values() if isinstance(task, RobosuiteTask)]
    for task in tasks:
        if name in (task.name, task.alias):
            state_dim = task.state_size(task.proprioception_keys)
            return InstructedTask(task.name, state_dim, task.action_dim, task.early_cut)
    names, suites = ", ".join(task.name for task in tasks), ", ".join(SUITES)
    raise InputError(
        f"task: expected one of {names}, their aliases or a suite of LIBERO ({suites}), got {name!r}"
    )


def instructed_env(
    task: str, policy: VLAPolicy, cameras: Mapping[str, str], horizon: int | None = None
) -> Callable[..., EnvBase]:
    """Return a factory of environments with the observations of ``policy``; call it with ``seeds``, like `make_env`.

    Args:
        task: see `find_instructed_task`, which says what it raises.
        policy: decides the size of the images and, by its ``source``, whether LIBERO's are prepared as for published policies.
        cameras: as in demonstrations: name of an observation here -> name of the images in the file. LIBERO has its own.
        horizon: steps until an episode is truncated; None for the task's own.

    Raises:
        InputError: if the policy was trained for another task, with other cameras, or reads or acts in other sizes than the
            task's; the message names both.

    Examples:
        >>> policy = VLAPolicy.from_pretrained("assets/vla")
        >>> instructed_env("lift", policy, policy.source.cameras)
        Traceback (most recent call last):
        ...
        torchrl_sparse.errors.InputError: policy: expected one that was trained for Lift, got one for LiftNamed
    """
    found = check_instructed(task, policy, cameras)
    options: dict[str, Any] = {"image_size": policy.network.config.image_size, "horizon": horizon}
    if found.name in SUITES:
        return partial(
            make_suite_env, found.name, as_released=policy.source.images == "openvla_oft", **options
        )
    shown: dict[str, Any] = {
        "n_obs_steps": 1,
        "object_state": False,
        "instruction": True,
        **camera_options(cameras),
    }
    return partial(make_env, found.name, **shown, **options)


def check_instructed(task: str, policy: VLAPolicy, cameras: Mapping[str, str]) -> InstructedTask:
    """Find a task, and refuse it if the policy would read its observations with another meaning.

    Args:
        task: see `find_instructed_task`, which says what it raises.
        policy: decides by its ``source``.
        cameras: name of an observation here -> name of the images in demonstrations; not read for a suite of LIBERO.

    Raises:
        InputError: as of `instructed_env`.
    """
    found, trained = find_instructed_task(task), policy.source.task
    if trained is not None and _known(trained) not in (None, found.name):
        raise InputError(f"policy: expected one that was trained for {found.name}, got one for {trained}")
    _check_sizes(found, policy)
    if found.name not in SUITES:
        _check_cameras(cameras, policy.source.cameras)
    return found


def continued_vla_source(task: str, policy: VLAPolicy, cameras: Mapping[str, str]) -> VLASource:
    """Return the ``source`` of a policy after further training: its own, naming the task it was last trained on.

    Args:
        task: that it is trained on now, see `find_instructed_task`.
        policy: that is trained on.
        cameras: of the demonstrations; noted where its ``source`` names none.

    Raises:
        InputError: if what it observes and commands is not the task's, or its cameras are others.
    """
    found = find_instructed_task(task)
    _check_sizes(found, policy)
    _check_cameras(cameras, policy.source.cameras)
    return replace(policy.source, task=found.name, cameras=policy.source.cameras or dict(cameras))


def _check_sizes(task: InstructedTask, policy: VLAPolicy) -> None:
    config = policy.network.config
    if (config.state_dim, config.action_dim) != (task.state_dim, task.action_dim):
        raise InputError(
            f"policy: expected one of {task.state_dim} observed numbers and {task.action_dim} of an action, for {task.name}, "
            f"got one of {config.state_dim} and {config.action_dim}"
        )


def _known(trained: str) -> str | None:
    return trained if trained in SUITES else named_task(trained)


def _check_cameras(cameras: Mapping[str, str], trained: Mapping[str, str]) -> None:
    """Refuse other cameras than the policy's own; those that it has not do no harm."""
    for name, key in trained.items():
        if cameras.get(name) != key:
            raise InputError(
                f"cameras.{name}: expected {key}, which the policy was trained with, got {cameras.get(name)}"
            )
