"""The options of `make_env` for an environment that shows what a policy observes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["camera_options", "env_options"]

_CAMERA_OPTIONS = {"image": "camera", "wrist_image": "wrist_camera"}


def env_options(policy: DiffusionPolicy) -> dict[str, Any]:
    """Return the arguments of `make_env` for an environment that shows what ``policy`` observes.

    Raises:
        ValueError: if the policy has cameras and its ``source`` does not name them.
    """
    options: dict[str, Any] = {"n_obs_steps": policy.n_obs_steps}
    if policy.vision is None:
        return options
    named = policy.source.get("cameras", {})
    cameras = {name: named.get(name, "") for name in policy.vision.cameras}
    if not all(cameras.values()) or not cameras.keys() <= _CAMERA_OPTIONS.keys():
        raise ValueError(f"policy.source['cameras']: expected those of {list(_CAMERA_OPTIONS)}, got {named}")
    return (
        options | camera_options(cameras) | {"image_size": policy.vision.image_size[0], "object_state": False}
    )


def camera_options(cameras: Mapping[str, str]) -> dict[str, str]:
    """Return the arguments of `make_env` for images, given by their names here and in demonstrations.

    >>> camera_options({"image": "agentview_image"})
    {'camera': 'agentview'}
    """
    return {_CAMERA_OPTIONS[name]: key.removesuffix("_image") for name, key in cameras.items()}
