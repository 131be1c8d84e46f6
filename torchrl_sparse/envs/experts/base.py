"""Base of scripted experts: read the hand's pose, choose the next waypoint, and take one clipped step towards it.

An expert decides from what a policy can observe too (poses, finger opening, motion), not from clocks or
remembered phases: its labels are then a function of the state, and it recovers by itself when something goes
wrong. Only the operator's `Style` is hidden.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.operators import Style

OPEN, CLOSED = -1.0, 1.0
DOWNWARD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""A Panda's grip site that points straight down; its fingers move along its x axis, here the world's y."""


@dataclass(frozen=True)
class Hand:
    """Current state of an arm's hand.

    Attributes:
        position: f64 [3] of the grip site, m, world frame.
        rotation: f64 [3, 3] of the grip site.
        velocity: f64 [3] of the grip site, m/s.
        opening: distance between the fingers, m: 0.08 fully open, 0 closed.
    """

    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    opening: float

    @property
    def yaw(self) -> float:
        """Rotation about the vertical relative to `DOWNWARD`, rad in (-pi, pi]."""
        return float(np.arctan2(-self.rotation[0, 0], self.rotation[1, 0]))

    @property
    def tilt(self) -> float:
        """Angle from pointing straight down, rad."""
        return float(np.arccos(np.clip(-self.rotation[2, 2], -1.0, 1.0)))


@dataclass(frozen=True)
class Waypoint:
    """Next goal of a hand.

    Attributes:
        position: f64 [3] of the grip site, m.
        rotation: f64 [3, 3] of the grip site.
        gripper: `OPEN` or `CLOSED`.
        pace: share of the operator's usual speed.
    """

    position: np.ndarray
    rotation: np.ndarray
    gripper: float
    pace: float = 1.0


class Expert(ABC):
    """A scripted expert for one episode of one robosuite environment.

    Args:
        sim_env: robosuite's environment under absolute world-frame poses (``RobosuiteEnv(...).sim_env``).
        style: the operator's draw for this episode.

    Examples:
        >>> from torchrl_sparse.envs.experts.operators import draw_operator
        >>> from torchrl_sparse.envs.tasks import find_task
        >>> from torchrl_sparse.envs.robosuite import RobosuiteEnv
        >>> env = RobosuiteEnv("Lift", seeds=[0])
        >>> _ = env.reset()
        >>> rng = np.random.default_rng(0)
        >>> style = draw_operator("proficient", rng).draw(rng)
        >>> find_task("Lift").load_expert()(env.sim_env, style).command().shape
        (7,)
    """

    def __init__(self, sim_env: Any, style: Style):
        self.sim_env = sim_env
        self.style = style

    @abstractmethod
    def waypoints(self) -> Sequence[Waypoint]:
        """Return one waypoint per arm for the current state."""

    def command(self) -> np.ndarray:
        """Return the absolute command, f64 [7 * arms]: position (m), rotation vector (rad), gripper."""
        pairs = zip(map(self.hand, range(len(self.sim_env.robots))), self.waypoints(), strict=True)
        return np.concatenate([self._step_towards(hand, waypoint) for hand, waypoint in pairs])

    def _step_towards(self, hand: Hand, waypoint: Waypoint) -> np.ndarray:
        left = Rotation.from_matrix(waypoint.rotation @ hand.rotation.T).as_rotvec()
        step = clipped(waypoint.position - hand.position, waypoint.pace * self.style.reach)
        turn = clipped(left, waypoint.pace * self.style.turn)
        rotation = Rotation.from_rotvec(turn) * Rotation.from_matrix(hand.rotation)
        return np.concatenate([hand.position + step, rotation.as_rotvec(), [waypoint.gripper]])

    # -- what an expert sees ----------------------------------------------------------------------

    def hand(self, arm: int = 0) -> Hand:
        """Return the hand of one arm."""
        data = self.sim_env.sim.data
        robot = self.sim_env.robots[arm]
        site = robot.eef_site_id["right"]
        left, right = data.qpos[robot._ref_gripper_joint_pos_indexes["right"]]
        return Hand(
            position=data.site_xpos[site].copy(),
            rotation=data.site_xmat[site].reshape(3, 3).copy(),
            velocity=data.get_site_xvelp(robot.gripper["right"].important_sites["grip_site"]),
            opening=float(left - right),
        )

    def body(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the position f64 [3] and rotation f64 [3, 3] of a body."""
        data = self.sim_env.sim.data
        index = self.sim_env.sim.model.body_name2id(name)
        return data.body_xpos[index].copy(), data.body_xmat[index].reshape(3, 3).copy()

    # -- skills -----------------------------------------------------------------------------------

    def above(
        self,
        hand: Hand,
        goal: np.ndarray,
        *,
        clearance: float | None = None,
        slope: float | None = None,
        slack: float = 0.01,
        turn: float = 0.0,
    ) -> np.ndarray:
        """Return the next point, f64 [3], of a funnel into ``goal``: height and bow shrink with the remaining distance.

        Args:
            hand: where the hand is.
            goal: f64 [3] where it should go, m.
            clearance: height of the funnel, m; the operator's ``hover`` by default.
            slope: metres of height for each metre left; the operator's by default.
            slack: horizontal distance from the goal within which the hand may be all the way down, m.
            turn: rad that the hand still has to turn before it may go down.
        """
        clearance = self.style.hover if clearance is None else clearance
        slope = self.style.slope if slope is None else slope
        away = goal[:2] - hand.position[:2]
        distance = float(np.linalg.norm(away))
        height = min(clearance, slope * max(0.0, distance + 0.05 * abs(turn) - slack))
        sideways = np.array([-away[1], away[0]]) / max(distance, 1e-6)
        bow = self.style.bow * np.clip((distance - 0.03) / 0.05, 0.0, 1.0)
        return goal + np.array([*(bow * sideways), height])


def at(hand: Hand, goal: np.ndarray, rotation: np.ndarray, *, position: float, angle: float = 0.1) -> bool:
    """Tell whether the hand is within ``position`` m and ``angle`` rad of a pose."""
    turn = Rotation.from_matrix(rotation @ hand.rotation.T).magnitude()
    return bool(np.linalg.norm(hand.position - goal) < position and turn < angle)


def downward(yaw: float) -> np.ndarray:
    """Return the rotation, f64 [3, 3], of a hand pointing straight down, turned by ``yaw`` rad about the vertical."""
    return Rotation.from_euler("z", yaw).as_matrix() @ DOWNWARD


def nearest(angle: float, reference: float, period: float) -> float:
    """Return the angle equal to ``angle`` modulo ``period`` that is nearest to ``reference``, rad.

    >>> round(nearest(3.0, 0.0, 3.0), 6)
    0.0
    """
    return reference + (angle - reference + period / 2) % period - period / 2


def clipped(vector: np.ndarray, length: float) -> np.ndarray:
    """Return the vector, scaled down to ``length`` if it is longer."""
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-9))
