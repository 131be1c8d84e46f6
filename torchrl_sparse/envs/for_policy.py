"""Environments that show exactly what a given diffusion policy observes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from torchrl_sparse.envs.conventions import source_convention
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, Task, find_task
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["camera_options", "diffusion_env", "named_task", "observed_keys"]

_CAMERA_OPTIONS = {"image": "camera", "wrist_image": "wrist_camera"}


def diffusion_env(task: str, policy: DiffusionPolicy, horizon: int | None = None) -> Callable[..., EnvBase]:
    """Return a maker of environments that show what ``policy`` was trained on; its keywords are those of `make_env`.

    Frames that no query of its executor sees are not rendered (``seen_frames`` of `RobosuiteEnv`; None renders all).

    Args:
        task: see `make_env`.
        policy: decides the history's length, the cameras and the size of their images, and by its ``source`` which
            observations make up the state, in which order, and which robosuite's meaning they have.
        horizon: steps until an episode is truncated; None for the task's own.

    Raises:
        ValueError: if the policy has cameras and its ``source`` does not say which, was trained for another task, or observes
            or acts in other names or sizes than the task's; the message names both.

    Examples:
        >>> make = diffusion_env("lift", DiffusionPolicy.from_pretrained("assets/lift"))
        >>> make(seeds=[7]).reset()["history", "state"].shape
        torch.Size([2, 19])
    """
    found = find_task(task)
    _check_task(found, policy)
    return partial(
        make_env,
        found.name,
        n_obs_steps=policy.n_obs_steps,
        horizon=horizon,
        **_state_options(found, policy),
        **_image_options(policy),
    )


def observed_keys(task: str, policy: DiffusionPolicy) -> tuple[str, ...]:
    """Return the names of the observations that make up the policy's state, in order: its own if it says so, else the task's.

    Args:
        task: a name or alias.
        policy: see `diffusion_env`; so are the errors.

    >>> observed_keys("lift", DiffusionPolicy.from_pretrained("assets/lift"))[0]
    'object'
    """
    found = find_task(task)
    _check_task(found, policy)
    own = found.state_keys if policy.vision is None else found.proprioception_keys
    return tuple(policy.source.get("state_keys") or own)


def _check_task(task: Task, policy: DiffusionPolicy) -> None:
    trained = policy.source.get("task")
    if trained is not None and named_task(trained) not in (None, task.name):
        raise ValueError(f"policy: expected one that was trained for {task.name}, got one for {trained}")
    _check_actions(task, policy.source)
    found = (policy.normalizer.state_scale.numel(), policy.normalizer.action_scale.numel())
    expected = (_state_size(task, policy), task.action_dim)
    if found != expected:
        raise ValueError(
            f"policy: expected one of {expected[0]} observed numbers and {expected[1]} of an action, for {task.name}, "
            f"got one of {found[0]} and {found[1]}"
        )


def _check_actions(task: Task, source: Mapping[str, Any]) -> None:
    """Refuse an imported policy whose actions are of the other kind than the task's: their sizes may be the same."""
    absolute = source.get("abs_action")
    if absolute is None and "weights" in source and not task.acts_in_poses:
        absolute = False  # as published code takes it; a pose of a robosuite arm is known by its size
    if task.abs_action is not None and absolute is not None and absolute != task.abs_action:
        kinds = {"True": "absolute actions (abs_action true)", "False": "relative actions (abs_action false)"}
        expected, got = (kinds.get(str(kind), repr(kind)) for kind in (task.abs_action, absolute))
        raise ValueError(f"policy: expected one of {expected} for {task.name}, got one of {got}")


def named_task(trained: str) -> str | None:
    """Return the name of the task that a published name, such as "lift_lowdim" or "blockpush_image", means.

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


def _state_size(task: Task, policy: DiffusionPolicy) -> int:
    state_keys = policy.source.get("state_keys")
    if state_keys is None:  # cameras replace a part of the state
        return policy.normalizer.state_scale.numel() if policy.vision else task.state_dim
    if isinstance(task, RobosuiteTask):
        try:
            return task.state_size(state_keys)
        except ValueError as error:
            raise ValueError(f"policy: {error}") from error
    if tuple(state_keys) != task.state_keys:
        expected, got = ", ".join(task.state_keys), ", ".join(state_keys)
        raise ValueError(f"policy: state_keys: expected {expected} for {task.name}, got {got}")
    return task.state_dim


def _state_options(task: Task, policy: DiffusionPolicy) -> dict[str, Any]:
    if not isinstance(task, RobosuiteTask) or not policy.source:
        return {}
    keys = policy.source.get("state_keys")
    named = {} if keys is None else {"state_keys": tuple(keys)}
    objects = (
        keys is None and policy.vision is not None
    )  # then no object is observed, whatever its convention
    convention = "1.5" if objects else source_convention(policy.source)
    return {**named, "convention": convention}


def _image_options(policy: DiffusionPolicy) -> dict[str, Any]:
    if policy.vision is None:
        return {}
    named = policy.source.get("cameras", {})
    cameras = {name: named.get(name, "") for name in policy.vision.cameras}
    if not all(cameras.values()) or not cameras.keys() <= _CAMERA_OPTIONS.keys():
        raise ValueError(f"policy.source['cameras']: expected those of {list(_CAMERA_OPTIONS)}, got {named}")
    shown = {"image_size": policy.vision.image_size[0], "seen_frames": policy.n_obs_steps}
    return {**camera_options(cameras), **shown, "object_state": False}


def camera_options(cameras: Mapping[str, str]) -> dict[str, str]:
    """Translate names of images, here and in demonstrations, into arguments of `make_env`.

    >>> camera_options({"image": "agentview_image"})
    {'camera': 'agentview'}
    """
    return {_CAMERA_OPTIONS[name]: key.removesuffix("_image") for name, key in cameras.items()}
