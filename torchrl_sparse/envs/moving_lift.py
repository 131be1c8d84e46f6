"""robosuite's Lift with a moving cube, pulled along a smooth path from under the table.

A policy that answers late grasps where the cube was. That makes this the task on which latency costs success.

Importing this module registers ``"LiftMoving"`` with robosuite; `make_simulator` does so.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchrl_sparse.envs.simulator import import_robosuite

import_robosuite()  # quietly, before anything else imports it
from robosuite.environments.manipulation.lift import Lift  # noqa: E402

SPEED = (0.06, 0.10)  # m/s, the amplitude of each axis's velocity; drawn per axis and episode
PERIOD = (2.5, 4.5)  # s, of the motion along each axis
_STIFFNESS = 3000.0  # 1/s², against friction: a lag of millimetres
_DAMPING = 110.0  # 1/s, critical
_FORCE = 2.0  # N at most: three times the cube's friction on the table, a fraction of the fingers' grip
_AIRBORNE = 0.005  # m above its rest at which the cube is let go

Path = Callable[[float], tuple[np.ndarray, np.ndarray]]


class LiftMoving(Lift):
    """Lift whose cube is pulled along a path on the table until it is lifted.

    The path follows from the cube's initial pose alone, to its last bit, so whatever restores an episode's start
    restores its motion too. The pull acts on the cube's centre and has limited strength: fingers stop the cube, and
    what pushes it aside is made good afterwards.
    """

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self._path: Path | None = None

    def _pre_action(self, action: np.ndarray, policy_step: bool = False) -> None:
        super()._pre_action(action, policy_step)
        data = self.sim.data
        if self._path is None:
            # Not at the reset: a restored state is only set after it.
            self._path = cube_path(data.get_joint_qpos(self.cube.joints[0]), start=data.time)
        position, velocity = data.body_xpos[self.cube_body_id], data.get_joint_qvel(self.cube.joints[0])[:3]
        force = np.zeros(3)
        if position[2] < self.table_offset[2] + self.cube.size[2] + _AIRBORNE:
            mass = self.sim.model.body_mass[self.cube_body_id]
            force[:2] = mass * _pull(self._path(data.time), position[:2], velocity[:2])
            force *= min(1.0, _FORCE / max(float(np.linalg.norm(force)), 1e-9))
        data.xfrc_applied[self.cube_body_id, :3] = force


def cube_path(pose: np.ndarray, *, start: float = 0.0) -> Path:
    """Return the path of a cube starting at ``pose``: a sine along each axis of the table.

    Args:
        pose: f64 [7] position (m) and quaternion; every bit counts.
        start: s, the time at which the cube is there.

    Returns:
        A function of the time, s, that gives position and velocity, f64 [2] each, m and m/s.

    >>> path = cube_path(np.array([0.01, -0.02, 0.83, 1.0, 0.0, 0.0, 0.0]))
    >>> path(0.0)[0]
    array([ 0.01, -0.02])
    """
    rng = np.random.default_rng(np.frombuffer(np.asarray(pose, np.float64).tobytes(), np.uint32))
    speed, rate = rng.uniform(*SPEED, 2), 2 * np.pi / rng.uniform(*PERIOD, 2)
    phase, origin = rng.uniform(0, 2 * np.pi, 2), np.array(pose[:2])

    def path(time: float) -> tuple[np.ndarray, np.ndarray]:
        angle = rate * (time - start) + phase
        return origin + speed / rate * (np.sin(angle) - np.sin(phase)), speed * np.cos(angle)

    return path


def _pull(goal: tuple[np.ndarray, np.ndarray], position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the acceleration, f64 [2] m/s², towards a point of the path."""
    return _STIFFNESS * (goal[0] - position) + _DAMPING * (goal[1] - velocity)
