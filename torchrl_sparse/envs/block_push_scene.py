"""The scene of block pushing as pybullet bodies, and the published initial states of episodes."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_sparse.envs.extras import import_extra

__all__ = ["BLOCK_SIZE", "WORKSPACE", "BlockPushScene", "Start", "published_start"]

WORKSPACE = np.array([[0.15, -0.5], [0.7, 0.5]])  # m: lowest and highest x, y of the effector's target
BLOCK_SIZE = 0.04  # m, of a cube's edge
ZONE_SIZE = 0.12  # m, of a target square's edge
SUBSTEPS = 24  # of pybullet's 1/240 s: 10 Hz

_BLOCK_MASS = 0.01
_BLOCK_INERTIA = 3 * _BLOCK_MASS * BLOCK_SIZE**2 / 6  # the published description scales it by 3
_TIP_MASS, _TIP_RADIUS, _TIP_LENGTH, _TIP_HEIGHT = 0.2, 0.001, 0.028, 0.031
_TIP_FORCE = 50.0  # N, with which the published arm holds its end effector
_TIP_START = np.array([0.3, -0.4])
_PACE = 0.1  # share of the distance left that is made good in a substep: pybullet's default position gain
_SETTLING = 100  # substeps

_CENTER_X = 0.4
_BLOCK_Y, _BLOCK_SPREAD, _BLOCK_GAP = -0.2, (0.1, 0.15), 0.1
_TARGET_Y, _TARGET_SPREAD, _TARGET_GAP, _TARGET_SIDE = 0.2, (0.005, 0.0075), 0.12, 0.12
_ATTEMPTS = 1000

_COLOURS = ((1.0, 0.34, 0.35, 1.0), (0.34, 1.0, 0.35, 1.0))
_TIP_COLOUR, _FLOOR_COLOUR = (0.18, 0.51, 0.77, 1.0), (0.2, 0.2, 0.2, 1.0)


@dataclass(frozen=True)
class Start:
    """Poses at the start of an episode: ``blocks`` and ``targets``, f64 [2, 3] each: x, y in m, yaw in rad."""

    blocks: np.ndarray
    targets: np.ndarray


def published_start(seed: int) -> Start:
    """Return the published initial state of a seed's episode, drawn from the same random stream.

    >>> start = published_start(100000)
    >>> (np.abs(np.diff(start.blocks[:, 0])) > 0.1).item(), start.targets[:, 1].round(2).tolist()
    (True, [0.2, 0.19])
    """
    rng = np.random.RandomState(seed)
    blocks = targets = np.zeros((2, 3))
    while abs(blocks[0, 0] - blocks[1, 0]) <= _BLOCK_GAP:
        first = _draw_pose(rng, (_CENTER_X, _BLOCK_Y), _BLOCK_SPREAD, (np.pi, 1.0))
        second = _draw_pose(rng, (_CENTER_X, _BLOCK_Y), _BLOCK_SPREAD, (np.pi, 1.0), first[0], _BLOCK_GAP)
        blocks = np.stack([first, second])
    yaws = (np.pi - np.pi / 30, np.pi + np.pi / 30)
    while abs(targets[0, 0] - targets[1, 0]) <= _TARGET_GAP:
        side = _TARGET_SIDE * rng.choice([-1, 1])
        first = _draw_pose(rng, (_CENTER_X + side, _TARGET_Y), _TARGET_SPREAD, yaws)
        second = _draw_pose(rng, (_CENTER_X - side, _TARGET_Y), _TARGET_SPREAD, yaws, first[0], _TARGET_GAP)
        targets = np.stack([first, second])
    return Start(blocks, targets)


def _draw_pose(
    rng: np.random.RandomState,
    center: tuple[float, float],
    spread: tuple[float, float],
    yaws: tuple[float, float],
    avoid: float | None = None,
    gap: float = 0.0,
) -> np.ndarray:
    """Draw x, y around ``center``, again while x lies within ``gap`` of ``avoid``, and a yaw."""
    for _ in range(_ATTEMPTS):
        x = center[0] + rng.uniform(-spread[0], spread[0])
        y = center[1] + rng.uniform(-spread[1], spread[1])
        if avoid is None or abs(x - avoid) > gap:
            break
    return np.array([x, y, rng.uniform(*yaws)])


class BlockPushScene:
    """Two blocks on a floor, two squares painted on it, and the movable tip of an end effector.

    Raises:
        ImportError: without pybullet, with the command that installs it.
    """

    _anchor: np.ndarray  # target position of the tip, f64 [2], m
    _hold: int  # the constraint that pulls the tip there

    def __init__(self) -> None:
        self._bullet = import_extra("pybullet", "blockpush")
        client = import_extra("pybullet_utils.bullet_client", "blockpush")
        self.client = client.BulletClient(self._bullet.DIRECT)
        self._ending = weakref.finalize(self, _disconnect, self.client)  # its own clean-up fails at exit

    def reset(self, start: Start) -> None:
        """Rebuild the scene: restoring a saved state would keep the last episode's contacts in the solver's memory."""
        client = self.client
        client.resetSimulation()
        client.setGravity(0, 0, -9.8)
        client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        self._add_box((15, 15, 5), (0, 0, -5.001), 0.0, mass=0, colour=_FLOOR_COLOUR)
        for (x, y, yaw), colour in zip(start.targets, reversed(_COLOURS), strict=True):
            half = ZONE_SIZE / 2
            self._add_box((half, half, 5e-4), (x, y, 0), yaw, mass=0, colour=colour, solid=False)
        size = (BLOCK_SIZE / 2,) * 3
        self.blocks = [
            self._add_box(size, (x, y, size[2]), yaw, mass=_BLOCK_MASS, colour=colour)
            for (x, y, yaw), colour in zip(start.blocks, _COLOURS, strict=True)
        ]
        for block in self.blocks:
            client.changeDynamics(block, -1, rollingFriction=1e-4, localInertiaDiagonal=(_BLOCK_INERTIA,) * 3)
        self._add_tip()
        for _ in range(_SETTLING):
            client.stepSimulation()

    def step(self, target: np.ndarray) -> None:
        """Pull the tip towards ``target``, f64 [2], m, for 0.1 s."""
        for _ in range(SUBSTEPS):
            self._anchor = self._anchor + _PACE * (target - self._anchor)
            self.client.changeConstraint(self._hold, (*self._anchor, _TIP_HEIGHT), maxForce=_TIP_FORCE)
            self.client.stepSimulation()

    def tip_position(self) -> np.ndarray:
        """Return the tip's position, f64 [2], m."""
        return np.array(self.client.getBasePositionAndOrientation(self.tip)[0][:2])

    def block_pose(self, index: int) -> np.ndarray:
        """Return a block's pose, f64 [3]: x and y in m, yaw in rad."""
        position, quaternion = self.client.getBasePositionAndOrientation(self.blocks[index])
        return np.array([*position[:2], self.client.getEulerFromQuaternion(quaternion)[2]])

    def place_block(self, index: int, pose: np.ndarray) -> None:
        """Place a block at rest at x, y (m) and yaw (rad)."""
        quaternion = self.client.getQuaternionFromEuler((0, 0, pose[2]))
        position = (pose[0], pose[1], BLOCK_SIZE / 2)
        self.client.resetBasePositionAndOrientation(self.blocks[index], position, quaternion)

    def render(self, height: int, width: int) -> np.ndarray:
        """Return u8 [height, width, 3], seen from in front of the robot, by pybullet's own renderer, which needs no GL."""
        client = self.client
        view = client.computeViewMatrix((1.0, 0.0, 0.75), (0.4, 0.0, 0.0), (0, 0, 1))
        projection = client.computeProjectionMatrixFOV(50, width / height, 0.1, 3.0)
        renderer = self._bullet.ER_TINY_RENDERER
        pixels = client.getCameraImage(width, height, view, projection, renderer=renderer)[2]
        return np.reshape(pixels, (height, width, 4))[..., :3].astype(np.uint8)

    def close(self) -> None:
        """Free the simulator."""
        self._ending()

    def _add_box(
        self,
        half: Sequence[float],
        position: Sequence[float],
        yaw: float,
        *,
        mass: float,
        colour: Sequence[float],
        solid: bool = True,
    ) -> int:
        client, box = self.client, self._bullet.GEOM_BOX
        shape = client.createCollisionShape(box, halfExtents=half) if solid else -1
        look = client.createVisualShape(box, halfExtents=half, rgbaColor=colour)
        turn = client.getQuaternionFromEuler((0, 0, yaw))
        body = client.createMultiBody(mass, shape, look, position, turn)
        client.changeDynamics(body, -1, lateralFriction=1.0)
        return body

    def _add_tip(self) -> None:
        client, cylinder = self.client, self._bullet.GEOM_CYLINDER
        shape = client.createCollisionShape(cylinder, radius=_TIP_RADIUS, height=_TIP_LENGTH)
        look = client.createVisualShape(
            cylinder, radius=5 * _TIP_RADIUS, length=_TIP_LENGTH, rgbaColor=_TIP_COLOUR
        )
        place = (*_TIP_START, _TIP_HEIGHT)
        self.tip = client.createMultiBody(_TIP_MASS, shape, look, place)
        client.changeDynamics(self.tip, -1, lateralFriction=1.0)
        self._anchor = _TIP_START
        fixed = self._bullet.JOINT_FIXED
        self._hold = client.createConstraint(self.tip, -1, -1, -1, fixed, (0, 0, 0), (0, 0, 0), place)
        client.changeConstraint(self._hold, place, maxForce=_TIP_FORCE)


def _disconnect(client: Any) -> None:
    client.disconnect()
