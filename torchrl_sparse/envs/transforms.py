"""Transforms between environment and policy: observation history, and velocity where the simulator does not report it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import CatFrames, Compose, InitTracker, TransformedEnv, UnsqueezeTransform
from torchrl.envs.transforms import Transform

from torchrl_sparse import keys
from torchrl_sparse.envs.tasks import RobosuiteTask, find_task
from torchrl_sparse.errors import InputError


def make_env(task: str, *, n_obs_steps: int = 2, **kwargs: Any) -> TransformedEnv:
    """Make a task's environment with the histories and ``"is_init"`` that a `DiffusionPolicy` in a `ChunkExecutor` reads.

    Args:
        task: of robosuite, see `RobosuiteEnv`, or of another simulator, see `torchrl_sparse.envs.tasks.TASKS`.
        n_obs_steps: entries of a history; the first of an episode is repeated at its start.
        kwargs: of the environment's class; cameras asked for there get a history too.

    Examples:
        >>> make_env("Lift").reset()["history", "state"].shape
        torch.Size([2, 19])
    """
    env = find_task(task).make(**kwargs)
    cameras = [key for key in (keys.IMAGE, keys.WRIST_IMAGE) if key in env.observation_spec.keys(True)]
    histories = [*state_history(n_obs_steps), *image_history(n_obs_steps, cameras)]
    return TransformedEnv(env, Compose(InitTracker(), *histories))


def state_history(n_obs_steps: int, state: NestedKey = keys.STATE) -> list[Transform]:
    """Return transforms that write the history of ``state``, f32 [*B, n_obs_steps, Ds], oldest first, under its last name."""
    history = keys.history_of(state)
    if n_obs_steps < 1:
        raise InputError(f"n_obs_steps: expected at least 1, got {n_obs_steps}")
    return [
        UnsqueezeTransform(dim=-2, in_keys=[state], out_keys=[history]),
        CatFrames(N=n_obs_steps, dim=-2, in_keys=[history]),
    ]


def image_history(n_obs_steps: int, cameras: Sequence[tuple[str, str]]) -> list[Transform]:
    """Return transforms that write ``("history", name)``, u8 [*B, n_obs_steps, 3, h, w], from ``("observation", name)``."""
    if not cameras:
        return []
    histories = [keys.history(name) for _, name in cameras]
    return [
        UnsqueezeTransform(dim=-4, in_keys=list(cameras), out_keys=histories),
        CatFrames(N=n_obs_steps, dim=-4, in_keys=histories),
    ]


class EndEffectorVelocity(Transform):
    """Transform that writes ``("observation", "eef_vel")`` from two successive poses, without a simulator.

    It is the mean over the step just made; the simulator's own, which `RobosuiteEnv` writes, is that at the step's end. Zero
    after a reset.

    Args:
        task: tells where each arm's position and quaternion (xyzw) lie in the state.
        control_freq: steps a second.
        key: of the state.
    """

    def __init__(self, task: RobosuiteTask, control_freq: float = 20.0, key: NestedKey = keys.STATE):
        super().__init__(in_keys=[key], out_keys=[keys.EEF_VEL])
        self.control_freq = control_freq
        self._key = key
        self._poses = task.pose_slices()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        state = tensordict_reset.get(self._key)
        return tensordict_reset.set(keys.EEF_VEL, state.new_zeros(*state.shape[:-1], 6 * len(self._poses)))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moved = twists(tensordict.get(self._key), next_tensordict.get(self._key), self._poses)
        return next_tensordict.set(keys.EEF_VEL, moved * self.control_freq)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = (*observation_spec.shape, 6 * len(self._poses))
        observation_spec[keys.EEF_VEL] = Unbounded(shape, device=observation_spec.device)
        return observation_spec


def twists(before: Tensor, after: Tensor, poses: Sequence[tuple[slice, slice]]) -> Tensor:
    """Return each arm's translation and rotation from one state to another, f32 [..., 6 * arms] in m and rad.

    Args:
        before, after: states [..., Ds].
        poses: for each arm, where its position and its quaternion (xyzw) lie in them.
    """
    moved = [
        part
        for pos, quat in poses
        for part in (
            after[..., pos] - before[..., pos],
            rotation_between(before[..., quat], after[..., quat]),
        )
    ]
    return torch.cat(moved, -1)


def rotation_between(before: Tensor, after: Tensor) -> Tensor:
    """Return the world-frame rotation vector, [..., 3] rad, from quaternion ``before`` to ``after`` ([..., 4], xyzw)."""
    xyz0, w0 = before[..., :3], before[..., 3:]
    xyz1, w1 = after[..., :3], after[..., 3:]
    xyz = w0 * xyz1 - w1 * xyz0 - torch.linalg.cross(xyz1, xyz0)  # after * conjugate(before)
    w = w0 * w1 + (xyz0 * xyz1).sum(-1, keepdim=True)
    xyz, w = torch.where(w < 0, -xyz, xyz), w.abs()
    sine = xyz.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    return xyz * torch.where(sine > 1e-8, angle / sine.clamp_min(1e-8), torch.full_like(sine, 2.0))
