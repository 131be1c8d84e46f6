"""Adapter from a plain robot loop to an executor: numpy arrays in and out, checked by name, without TorchRL around them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError

__all__ = ["PlainLoop"]


class PlainLoop:
    """Episode of one robot under an executor; keeps history and carried keys, as an environment and a collector would.

    Args:
        executor: a `ChunkExecutor`, whose policy has ``n_obs_steps`` and a ``normalizer``, as a `DiffusionPolicy` has.
        seed: of the noise, that an environment's episode of this seed has too; None for torch's global generator.
    """

    def __init__(self, executor: TensorDictModuleBase, seed: int | None):
        self._executor = executor
        policy: Any = executor.policy
        if keys.HISTORY_STATE not in policy.in_keys or not hasattr(policy, "n_obs_steps"):
            raise InputError(
                f"policy: expected one that reads {keys.HISTORY_STATE}, got {type(policy).__name__}"
            )
        self._policy, self._seed, self._step = policy, seed, 0
        self._past: dict[str, deque[Tensor]] = {
            key[1]: deque(maxlen=policy.n_obs_steps) for key in executor.in_keys if key[0] == "history"
        }
        self._now: dict[str, Tensor] = {}
        self._read_now = {key[1] for key in executor.in_keys if key[0] == "observation"} - self._past.keys()
        self._carried: TensorDictBase = TensorDict()

    @property
    def names(self) -> set[str]:
        """What an observation consists of."""
        return self._past.keys() | self._read_now

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the action of the current step; see `ChunkExecutor.act`."""
        self.remember(observation)
        for key, value in self.reads().items():
            self._carried[key] = value
        device = self._policy.normalizer.state_scale.device
        self._carried = self._executor(self._carried.to(device)).detach()
        self.advance()
        return self._carried[self._executor.tensor_keys["action"]].cpu().numpy()

    def remember(self, *observations: Mapping[str, np.ndarray]) -> None:
        """Take observations into the history, oldest first; the last is that of the current step.

        Raises:
            InputError: as of `ChunkExecutor.act`; none of them is kept, so that they can be handed over again mended.
        """
        for step in [self._check(observation) for observation in observations]:
            for name, past in self._past.items():
                past.extend([step[name]] * (1 if past else past.maxlen or 1))
            self._now = {name: step[name] for name in self._read_now}

    def reads(self) -> dict[NestedKey, Tensor]:
        """Return what the executor reads at the current step, but for what its last call left."""
        read: dict[NestedKey, Tensor] = {
            keys.history(name): torch.stack([*past]) for name, past in self._past.items()
        }
        read |= {("observation", name): value for name, value in self._now.items()}
        read[keys.IS_INIT] = torch.tensor([self._step == 0])
        if self._seed is not None:
            read[keys.EPISODE_SEED] = torch.tensor([self._seed])
            read[keys.EPISODE_STEP] = torch.tensor([self._step])
        return read

    def advance(self) -> None:
        """Go on to the next step."""
        self._step += 1

    def _check(self, observation: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
        if observation.keys() != self.names:
            expected, got = sorted(self.names), sorted(observation)
            raise InputError(
                f"observation: expected {', '.join(expected)}, got {', '.join(got) or 'nothing'}"
            )
        return {name: self._read(name, np.asarray(value)) for name, value in observation.items()}

    def _read(self, name: str, value: np.ndarray) -> Tensor:
        if name in ("image", "wrist_image", *getattr(self._policy.vision, "cameras", ())):
            return _image(name, value, tuple(self._policy.vision.image_size))
        size = self._policy.normalizer.state_scale.numel() if name == "state" else None
        return _numbers(name, value, size)


def _numbers(name: str, value: np.ndarray, size: int | None) -> Tensor:
    expected = f"{name}: expected {'' if size is None else f'{size} '}finite numbers in one row"
    if value.dtype.kind not in "fiu":
        raise InputError(f"{expected}, got dtype {value.dtype}")
    if value.ndim != 1 or size not in (None, len(value)):
        raise InputError(f"{expected}, got shape {value.shape}")
    with np.errstate(over="ignore"):
        numbers = value.astype(np.float32)
    if not np.isfinite(numbers).all():
        raise InputError(f"{expected} of float32, got {value.tolist()}")
    return torch.from_numpy(numbers)


def _image(name: str, value: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Return u8 [3, h, w] of an image in that layout or, as cameras give it, in [h, w, 3]."""
    expected = f"{name}: expected uint8 of shape {(*size, 3)} or {(3, *size)}"
    if value.dtype != np.uint8:
        raise InputError(f"{expected}, got dtype {value.dtype}")
    if value.shape == (*size, 3):
        value = value.transpose(2, 0, 1)
    if value.shape != (3, *size):
        raise InputError(f"{expected}, got shape {value.shape}")
    return torch.from_numpy(value.copy())
