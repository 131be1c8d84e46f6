"""Disturbances of an operator's intended commands: noise, pauses, bumps, slips and missed grasps."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.operators import Operator
from torchrl_sparse.rotations import POSE_DIM

_MEMORY = 0.8  # autocorrelation of the noise from one step to the next
_RAD_PER_M = 4.0  # 8 mm of position noise come with 0.03 rad of rotation noise
_CALM = 0.06  # m of commanded step above which noise is at its full size; careful motions are made with less
_BUMP_STEPS = 4
_BUMP_SIZE = (0.03, 0.06)  # m
_SLIP_STEPS = 4
_PAUSE_STEPS = (3, 9)
_MISS_STEPS = (6, 18)
_MISS_NEAR = 0.03  # m of commanded step below which an open hand is about to grasp
_CLOSING_STEPS = 4  # in which the fingers close where they are, before the hand goes on without the object
_MISS_RISE = 0.04  # m, how far ahead of the hand it then goes


class Disturbance:
    """Converter of one episode's clean commands to executed ones.

    Expert labels stay clean while the executed noise widens the states that they are given for, as in DART
    (arXiv:1703.09327); noise shrinks with the commanded step, so grasps and insertions stay possible.

    Args:
        operator: its ``noise``, ``bump``, ``slip``, ``miss`` and ``hesitation``.
        arms: number of arms; each has its own noise.
        rng: generator of this episode.
    """

    def __init__(self, operator: Operator, arms: int, rng: np.random.Generator):
        self._operator = operator
        self._rng = rng
        self._noise = np.zeros((arms, 6))
        self._push = np.zeros(3)
        self._steps = 0
        self._closed_steps = 0
        self._pause_left = 0
        self._bump_start = rng.integers(3, 40) if rng.random() < operator.bump else None
        self._slip_start = rng.integers(3, 6) if rng.random() < operator.slip else None
        self._missed_steps = 0
        # Operators that never miss draw nothing, so that their demonstrations stay what they were.
        misses = operator.miss and rng.random() < operator.miss
        self._miss_steps = int(rng.integers(*_MISS_STEPS)) if misses else 0
        self._miss_drift = rng.uniform(-1.0, 1.0, 2) if misses else np.zeros(2)

    def __call__(self, clean: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return the command to execute.

        Args:
            clean: f64 [7 * arms] the expert's command.
            present: f64 [arms, 3] where the hands are, m.

        Returns:
            f64 [7 * arms].
        """
        arms = clean.reshape(-1, POSE_DIM).copy()
        self._noise = next_noise(self._noise, self._rng)
        calm = np.clip(np.linalg.norm(arms[:, :3] - present, axis=-1, keepdims=True) / _CALM, 0.25, 1.0)
        if self._pausing():
            arms[:, :3] = present
        size = self._operator.noise * calm
        arms[:, :3] += size * self._noise[:, :3] + self._bumped()
        turned = Rotation.from_rotvec(size * _RAD_PER_M * self._noise[:, 3:]) * Rotation.from_rotvec(
            arms[:, 3:6]
        )
        arms[:, 3:6] = turned.as_rotvec()
        arms[0, 6] = self._slipped(arms[0, 6])
        if self._missing(clean[:POSE_DIM], present[0]):
            self._miss(arms[0], present[0])
        self._steps += 1
        return arms.reshape(-1)

    def _pausing(self) -> bool:
        if self._pause_left:
            self._pause_left -= 1
            return True
        if self._rng.random() < self._operator.hesitation:
            self._pause_left = int(self._rng.integers(*_PAUSE_STEPS))
        return False

    def _bumped(self) -> np.ndarray:
        if self._steps == self._bump_start:
            direction = self._rng.standard_normal(3)
            direction[2] = abs(direction[2])  # up: a push into the table would break more than it teaches
            self._push = direction / np.linalg.norm(direction) * self._rng.uniform(*_BUMP_SIZE)
        over = self._bump_start is None or self._steps >= self._bump_start + _BUMP_STEPS
        return np.zeros(3) if over else self._push

    def _slipped(self, gripper: float) -> float:
        self._closed_steps = self._closed_steps + 1 if gripper > 0 else 0
        if self._slip_start is None or self._closed_steps < self._slip_start:
            return gripper
        if self._closed_steps == self._slip_start + _SLIP_STEPS - 1:
            self._slip_start = None
        return -1.0

    def _missing(self, clean: np.ndarray, present: np.ndarray) -> bool:
        """Tell whether the fingers are being closed on nothing: once begun, it goes on for the steps drawn."""
        near = clean[6] < 0 and np.linalg.norm(clean[:3] - present) < _MISS_NEAR
        return self._missed_steps < self._miss_steps and bool(self._missed_steps or near)

    def _miss(self, command: np.ndarray, present: np.ndarray) -> None:
        """Close the fingers, then take the hand away as if they held something."""
        command[6] = 1.0
        if self._missed_steps >= _CLOSING_STEPS:
            command[:3] = present + _MISS_RISE * np.array([*self._miss_drift, 1.0])
        self._missed_steps += 1


def next_noise(noise: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the next step's standard normal noise, correlated with this step's; same shape."""
    return _MEMORY * noise + np.sqrt(1 - _MEMORY**2) * rng.standard_normal(noise.shape)
