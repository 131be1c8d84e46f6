"""Environments that return exactly the observations of a given diffusion policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchrl.envs import EnvBase

from torchrl_sparse.envs.contract import policy_contract
from torchrl_sparse.envs.tasks import RobosuiteTask, find_task
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["camera_options", "diffusion_env"]

_CAMERA_OPTIONS = {"image": "camera", "wrist_image": "wrist_camera"}


def diffusion_env(task: str, policy: DiffusionPolicy, horizon: int | None = None) -> Callable[..., EnvBase]:
    """Return a factory of environments with the observations ``policy`` was trained on; its keywords are those of `make_env`.

    Frames that no policy call of its executor sees are not rendered (``seen_frames`` of `RobosuiteEnv`; None renders all).

    Args:
        task: see `make_env`.
        policy: decides the history's length and the size of images, and by its contract all else; see `policy_contract`.
        horizon: steps until an episode is truncated; None for the task's own.

    Raises:
        InputError: as of `policy_contract`; so for cameras that no environment has.

    Examples:
        >>> make = diffusion_env("lift", DiffusionPolicy.from_pretrained("assets/lift"))
        >>> make(seeds=[7]).reset()["history", "state"].shape
        torch.Size([2, 19])
    """
    contract = policy_contract(task, policy)
    options: dict[str, Any] = {"n_obs_steps": policy.n_obs_steps}
    if horizon is not None:  # else an environment has its own default
        options["horizon"] = horizon
    if isinstance(found := find_task(task), RobosuiteTask):
        options |= {"state_keys": contract.state_keys, "convention": contract.convention}
    if policy.vision is not None:
        shown = {"image_size": policy.vision.image_size[0], "seen_frames": policy.n_obs_steps}
        options |= {**camera_options(contract.cameras), **shown, "object_state": False}
    return partial(make_env, found.name, **options)


def camera_options(cameras: Mapping[str, str]) -> dict[str, str]:
    """Translate image names, here and in demonstrations, to arguments of `make_env`; ValueError for unknown names.

    >>> camera_options({"image": "agentview_image"})
    {'camera': 'agentview'}
    """
    if not cameras.keys() <= _CAMERA_OPTIONS.keys():
        raise InputError(
            f"policy.source['cameras']: expected those of {list(_CAMERA_OPTIONS)}, got {dict(cameras)}"
        )
    return {_CAMERA_OPTIONS[name]: key.removesuffix("_image") for name, key in cameras.items()}
