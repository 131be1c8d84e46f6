"""Lift one of five named cubes while an irrelevant ball circles them.

The moving object in the images is irrelevant to the task: a pruner that keeps the visual tokens that changed since the last
    policy call keeps the
ball's. That tells it from one that also asks what the model attends to, which LiftNamed, where only the arm moves, does not.

Importing this module registers ``"LiftCrowded"`` with robosuite; `make_simulator` does so.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np

from torchrl_sparse.envs.named_lift import LiftNamed

CROWD = ("red", "green", "blue", "yellow", "purple")
# m, half axes of the ball's ellipse about the table's centre, outside of where cubes are placed
RADII = (0.21, 0.25)
PERIOD = (4.0, 6.0)  # s, of a round: about 0.3 m/s
BALL_RADIUS = 0.025  # m
_RGBA = "1 0.5 0 1"
_JOINTS = ("distractor_x", "distractor_y")

Orbit = Callable[[float], np.ndarray]


class LiftCrowded(LiftNamed):
    """`LiftNamed` with two more cubes and a ball that circles all cubes on the table.

    The ball is seen and touches nothing: whether a cube is lifted does not depend on it. Where it starts is drawn at a reset;
    how fast and which way it goes follows from there, to the last bit, so what restores an episode's start restores its motion.
    """

    colours = CROWD
    x_range, y_range = (-0.10, 0.10), (-0.15, 0.15)

    def _load_model(self) -> None:
        super()._load_model()
        self.model.worldbody.append(_ball(self.table_offset + np.array([0.0, 0.0, BALL_RADIUS])))

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self._orbit: Orbit | None = None
        angle = self.rng.uniform(0, 2 * np.pi)
        self._put(np.array(RADII) * [np.cos(angle), np.sin(angle)])

    def _pre_action(self, action: np.ndarray, policy_step: bool = False) -> None:
        super()._pre_action(action, policy_step)
        data = self.sim.data
        if self._orbit is None:
            # Not at the reset: a restored state is only set after it.
            place = np.array([data.get_joint_qpos(joint) for joint in _JOINTS])
            self._orbit = orbit(place, start=data.time)
        self._put(self._orbit(data.time))

    def _put(self, place: np.ndarray) -> None:
        """Put the ball at ``place``, f64 [2] m from the table's centre, at rest: nothing but this moves it."""
        for joint, number in zip(_JOINTS, place, strict=True):
            self.sim.data.set_joint_qpos(joint, number)
            self.sim.data.set_joint_qvel(joint, 0.0)


def orbit(place: np.ndarray, *, start: float = 0.0) -> Orbit:
    """Return the path of a ball starting at ``place``: laps of the ellipse through it.

    Args:
        place: f64 [2], m from the table's centre; every bit counts.
        start: s, the time at which the ball is there.

    Returns:
        A function of the time, s, that gives the place, f64 [2].

    >>> orbit(np.array([0.21, 0.0]))(0.0)
    array([0.21, 0.  ])
    """
    rng = np.random.default_rng(np.frombuffer(np.asarray(place, np.float64).tobytes(), np.uint32))
    rate = 2 * np.pi / rng.uniform(*PERIOD) * rng.choice((-1, 1))
    x, y = np.asarray(place) / RADII

    def path(time: float) -> np.ndarray:
        cos, sin = np.cos(rate * (time - start)), np.sin(rate * (time - start))
        return np.array(RADII) * [x * cos - y * sin, x * sin + y * cos]

    return path


def _ball(centre: np.ndarray) -> ET.Element:
    body = ET.Element("body", name="distractor", pos=" ".join(map(str, centre)))
    for joint, axis in zip(_JOINTS, ("1 0 0", "0 1 0"), strict=True):
        ET.SubElement(body, "joint", name=joint, type="slide", axis=axis)
    # robosuite takes no mass from what is only seen.
    ET.SubElement(body, "inertial", pos="0 0 0", mass="0.01", diaginertia="1e-5 1e-5 1e-5")
    seen = {"type": "sphere", "size": str(BALL_RADIUS), "rgba": _RGBA}
    untouchable = {"contype": "0", "conaffinity": "0", "group": "1"}
    ET.SubElement(body, "geom", seen | untouchable)
    return body
