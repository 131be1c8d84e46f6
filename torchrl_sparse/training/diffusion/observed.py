"""Demonstrations as a trained policy observes them."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse.data.robomimic import Demonstrations, read_demos
from torchrl_sparse.envs.for_policy import observed_keys
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["encode_windows", "policy_demos"]

_ENCODE_BATCH = 64  # windows whose images are in memory as floats at a time


def policy_demos(path: str | Path, task: str, policy: DiffusionPolicy) -> Demonstrations:
    """Read a task's demonstrations with the state and the cameras that ``policy`` was trained on.

    Args:
        path: HDF5 file, see `read_demos`.
        task: a name or alias.
        policy: see `diffusion_env`.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: as `read_demos` and `diffusion_env`; so if the file has no images of the policy's cameras.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy_demos("data/lift.h5", "lift", policy).data["observation", "state"].shape[1]  # doctest: +SKIP
        19
    """
    found = find_task(task)
    return read_demos(
        path,
        observed_keys(found.name, policy),
        cameras=policy.source.get("cameras"),
        poses=found.acts_in_poses,
        task=found.name,
    )


@torch.no_grad()
def encode_windows(policy: DiffusionPolicy, windows: TensorDict) -> Tensor:
    """Return the condition f32 [B, To, D] of windows [B] of `Demonstrations.windows`, where the policy is."""
    condition = policy.module["encode"].condition
    return torch.cat([condition(part.to(policy.device)) for part in windows.split(_ENCODE_BATCH)])
