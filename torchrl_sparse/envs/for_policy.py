"""Environments that show exactly what a given policy observes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from torchrl_sparse.envs.tasks import Task, find_robosuite_task, find_task
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["diffusion_env", "instructed_env"]

_CAMERA_OPTIONS = {"image": "camera", "wrist_image": "wrist_camera"}


def diffusion_env(task: str, policy: DiffusionPolicy, horizon: int | None = None) -> Callable[..., EnvBase]:
    """Return a maker of environments whose histories and cameras are those of ``policy``; its keywords are those of `make_env`.

    Args:
        task: see `make_env`.
        policy: decides the history's length, the cameras and the size of their images.
        horizon: steps until an episode is truncated; None for the task's own.

    Raises:
        ValueError: if the policy has cameras and its ``source`` does not say which, or it observes or acts in other sizes than
            the task's.

    Examples:
        >>> make = diffusion_env("lift", DiffusionPolicy.from_pretrained("assets/lift"))
        >>> make(seeds=[7]).reset()["history", "state"].shape
        torch.Size([2, 19])
    """
    _check_sizes(find_task(task), policy)
    return partial(
        make_env,
        find_task(task).name,
        n_obs_steps=policy.n_obs_steps,
        horizon=horizon,
        **_image_options(policy),
    )


def instructed_env(
    task: str, config: VLAConfig, cameras: Mapping[str, str], horizon: int | None = None
) -> Callable[..., EnvBase]:
    """Return a maker of environments that show and say what a `VLAPolicy` reads; its keywords are those of `make_env`.

    Args:
        task: of robosuite, see `make_env`.
        config: of the policy's network; decides the size of the images.
        cameras: as in demonstrations: name of an observation here -> name of the images in the file.
        horizon: steps until an episode is truncated; None for the task's own.
    """
    return partial(
        make_env,
        find_robosuite_task(task).name,
        n_obs_steps=1,
        image_size=config.image_size,
        object_state=False,
        instruction=True,
        horizon=horizon,
        **_camera_options(cameras),
    )


def _check_sizes(task: Task, policy: DiffusionPolicy) -> None:
    found = (policy.normalizer.state_scale.numel(), policy.normalizer.action_scale.numel())
    expected = (
        found[0] if policy.vision else task.state_dim,
        task.action_dim,
    )  # cameras replace a part of the state
    if found != expected:
        raise ValueError(
            f"policy: expected one of {expected[0]} observed numbers and {expected[1]} of an action, for {task.name}, "
            f"got one of {found[0]} and {found[1]}"
        )


def _image_options(policy: DiffusionPolicy) -> dict[str, Any]:
    if policy.vision is None:
        return {}
    named = policy.source.get("cameras", {})
    cameras = {name: named.get(name, "") for name in policy.vision.cameras}
    if not all(cameras.values()) or not cameras.keys() <= _CAMERA_OPTIONS.keys():
        raise ValueError(f"policy.source['cameras']: expected those of {list(_CAMERA_OPTIONS)}, got {named}")
    return {**_camera_options(cameras), "image_size": policy.vision.image_size[0], "object_state": False}


def _camera_options(cameras: Mapping[str, str]) -> dict[str, str]:
    """Translate names of images, here and in demonstrations, into arguments of `make_env`.

    >>> _camera_options({"image": "agentview_image"})
    {'camera': 'agentview'}
    """
    return {_CAMERA_OPTIONS[name]: key.removesuffix("_image") for name, key in cameras.items()}
