"""Scripted expert for TwoArmTransport: one arm uncovers and offers the hammer, the other clears its bin and takes it.

The first arm ("giver", robot 0) lifts the lid off the start bin, puts it beside, and holds the hammer out between
the tables. The second ("taker", robot 1) carries the trash out of the target bin meanwhile, grasps the hammer by
the other end of its handle, waits until it has been let go, and puts it into the target bin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import (
    CLOSED,
    OPEN,
    Expert,
    Hand,
    Waypoint,
    at,
    clipped,
    downward,
    nearest,
)

_BASES = np.array([[0.0, -0.81], [0.0, 0.81]])  # m, where the arms stand
_WALL_TOP = 0.951  # m, of all three bins
_OVER_WALLS = 1.02  # m, height at which a hand, or what it holds, travels sideways at least
_STEEP = 6.0  # slope of the way into a bin: between the walls there is room for the hand, not for much more
_ROOM = 0.14  # m from the middle of a bin to its walls

_LID_WIDTH, _TRASH_WIDTH, _HANDLE_WIDTH = 0.02, 0.04, 0.03  # m between the fingers
_LID_HANDLE = np.array([0.0, 0.0, 0.005])  # m, in the lid's frame
_LID_PLACE = np.array([-0.22, -0.45, 0.828])  # m, its handle's on the free half of the table
_LID_CLEAR = -0.12  # m, x of the lid from which it leaves the start bin open
_LID_LOW = 0.845  # m, height of the lid's handle from which it may be let go

_TRASH_LOW = 0.90  # m, the trash's height when let go
_GIVER_GRASP, _TAKER_GRASP = -0.04, 0.078  # m along the handle, from its middle towards the taker
_LEAN = 0.3  # rad by which the taker leans back, since upright both palms would meet
_HANDLE_HALF = 0.1  # m
_HEAD_SHIFT = 0.017  # m from the handle's middle towards the head: the centre of the whole hammer
_OFFER = np.array([0.0, -0.01, 1.08])  # m, the hammer's centre where it changes hands
_PLACED = 0.89  # m, the hammer's height in the target bin when let go
_PLACED_YAW = 0.75 * np.pi  # rad, along the diagonal: there is more room, and the arm need not fold up
_PLACED_BACK = 0.025  # m along the hammer from the bin's middle, so that the hand is nearer to it
_BELOW = 0.015  # m below the height at which something is let go that is aimed at
_BRAKE = 0.15  # s, how much of a hand's sideways drift is taken back while it rises
_CAREFUL = 0.042  # m up or down at a time: near its base, an arm that is sped up or down drifts sideways
_FIRM = 1.5  # the arms are compliant: a target beyond the goal by this factor is reached sooner
_FREE = 0.02  # m of play between fingers and what they let go, from which they may leave
_FOLDED = 0.37  # m from the arm's base; nearer, the elbow is at its limit and the hand cannot rise
_SWING = 0.44  # m from the arm's base that are kept on the way sideways
_NEARLY = 0.12  # m from the goal at which that way ends
_HOMES = np.array([[0.0, -0.35, 1.12], [0.0, 0.24, 1.15]])  # m, where a hand waits


@dataclass(frozen=True)
class Hammer:
    """Pose of the lying hammer.

    Attributes:
        middle: f64 [3] m, of its handle.
        centre: f64 [3] m, of the whole hammer: half-way between the tip of its handle and its head.
        along: f64 [3] unit vector of its axis; of the two, the one that points to the taker (+y).
    """

    middle: np.ndarray
    centre: np.ndarray
    along: np.ndarray

    @property
    def yaw(self) -> float:
        """Yaw of a hand whose fingers close across the handle, rad; modulo pi."""
        return float(np.arctan2(self.along[1], self.along[0]))

    def point(self, ahead: float) -> np.ndarray:
        """Return the point f64 [3] that is ``ahead`` m from the handle's middle, towards the receiving arm."""
        return self.middle + ahead * self.along

    def across(self, hand: Hand, lean: float = 0.0) -> np.ndarray:
        """Return the rotation f64 [3, 3] of a hand grasping across the handle with least turn, its palm ``lean`` rad back."""
        level = downward(nearest(self.yaw, hand.yaw, np.pi))
        return level @ Rotation.from_euler("x", -lean).as_matrix()

    def distance(self, hand: Hand) -> float:
        """Return the hand's distance to the nearest point of the handle's axis, m."""
        ahead = np.clip((hand.position - self.middle) @ self.along, -_HANDLE_HALF, _HANDLE_HALF)
        return float(np.linalg.norm(hand.position - self.point(ahead)))

    def held_by(self, hand: Hand) -> bool:
        return self.distance(hand) < 0.025 and hand.opening < _HANDLE_WIDTH + 0.007


class TwoArmTransportExpert(Expert):
    """Expert whose two arms decide independently and meet when the state shows that the other arm is ready."""

    def waypoints(self) -> Sequence[Waypoint]:
        giver, taker, hammer = self.hand(0), self.hand(1), self._hammer()
        return [self._give(giver, taker, hammer), self._take(giver, taker, hammer)]

    def _hammer(self) -> Hammer:
        middle, rotation = self.body(self.sim_env.transport.payload.root_body)
        head = rotation[:, 2]
        return Hammer(middle, middle + _HEAD_SHIFT * head, head if head[1] >= 0 else -head)

    # -- the giver --------------------------------------------------------------------------------

    def _give(self, hand: Hand, taker: Hand, hammer: Hammer) -> Waypoint:
        if hammer.held_by(taker):
            return self._hand_over(hand, hammer)
        lid, rotation = self.body(self.sim_env.transport.lid.root_body)
        handle = lid + rotation @ _LID_HANDLE
        aside = handle[0] < _LID_CLEAR and handle[2] < _LID_LOW
        if not aside or _around(hand, handle, _LID_WIDTH):
            return self._clear_lid(hand, handle, rotation, aside)
        if hammer.held_by(hand):
            turn = nearest(np.pi / 2 - hammer.yaw, 0.0, np.pi)
            return self._carry(hand, hammer.centre, _OFFER, turn, slack=0.06)
        if hammer.middle[1] > 0:
            return self._wait(hand, 0)
        return self._grasp(hand, hammer.point(_GIVER_GRASP), hammer.across(hand))

    def _clear_lid(self, hand: Hand, handle: np.ndarray, rotation: np.ndarray, aside: bool) -> Waypoint:
        if aside:
            return _stay(hand, OPEN)
        if _holds(hand, handle, _LID_WIDTH):
            return self._carry(hand, handle, _LID_PLACE, _azimuth(hand.position, 0) - hand.yaw, slack=0.04)
        return self._grasp(hand, handle, downward(nearest(_yaw(rotation) + np.pi / 2, np.pi / 2, np.pi)))

    def _hand_over(self, hand: Hand, hammer: Hammer) -> Waypoint:
        if hammer.distance(hand) > 0.08:
            return self._wait(hand, 0)
        if hand.opening < _HANDLE_WIDTH + _FREE:
            return _stay(hand, OPEN)
        return Waypoint(hand.position + np.array([0.0, 0.0, _CAREFUL]), hand.rotation, OPEN)

    # -- the taker --------------------------------------------------------------------------------

    def _take(self, giver: Hand, hand: Hand, hammer: Hammer) -> Waypoint:
        if hammer.held_by(hand):
            return self._place(giver, hand, hammer)
        trash, rotation = self.body(self.sim_env.transport.trash.root_body)
        cleared = _within(trash, self.sim_env.transport.trash_bin_pos) and trash[2] < _TRASH_LOW
        if not cleared or _around(hand, trash, _TRASH_WIDTH):
            return self._clear_trash(hand, trash, rotation, cleared)
        offered = hammer.held_by(giver) and np.linalg.norm(hammer.centre - _OFFER) < 0.05
        dropped = hammer.middle[1] > 0.25 and not self._is_placed(hammer)
        if offered or dropped:
            return self._grasp(hand, hammer.point(_TAKER_GRASP), hammer.across(hand, _LEAN))
        return self._wait(hand, 1)

    def _clear_trash(self, hand: Hand, trash: np.ndarray, rotation: np.ndarray, cleared: bool) -> Waypoint:
        if cleared:
            return _stay(hand, OPEN)
        if _holds(hand, trash, _TRASH_WIDTH):
            place = np.array([*self.sim_env.transport.trash_bin_pos[:2], _TRASH_LOW - _BELOW])
            return self._carry(hand, trash, place, _azimuth(hand.position, 1) - hand.yaw, slack=0.05)
        # Between the bins a hand has room only with its fingers along them.
        reference = 0.0 if abs(trash[0]) < 0.06 else _azimuth(trash, 1)
        return self._grasp(hand, trash, downward(nearest(_yaw(rotation), reference, np.pi / 2)))

    def _place(self, giver: Hand, hand: Hand, hammer: Hammer) -> Waypoint:
        if hammer.distance(giver) < 0.05:
            return _stay(hand, CLOSED)
        if self._is_placed(hammer):
            return _stay(hand, OPEN)
        middle = np.array([*self.sim_env.transport.target_bin_pos[:2], _PLACED - _BELOW])
        turn = nearest(_PLACED_YAW - hammer.yaw, 0.0, np.pi)
        return self._carry(hand, hammer.centre, middle - _PLACED_BACK * hammer.along, turn, slack=0.025)

    def _is_placed(self, hammer: Hammer) -> bool:
        return _within(hammer.middle, self.sim_env.transport.target_bin_pos) and hammer.middle[2] < _PLACED

    # -- skills of both ---------------------------------------------------------------------------

    def _grasp(self, hand: Hand, goal: np.ndarray, aligned: np.ndarray) -> Waypoint:
        grasp = goal + self.style.offset * aligned[:, 1]
        if at(hand, grasp, aligned, position=0.012):
            return Waypoint(grasp, aligned, CLOSED)
        return self._reach(hand, grasp, aligned, slack=0.018)

    def _wait(self, hand: Hand, arm: int) -> Waypoint:
        return self._reach(hand, _HOMES[arm], downward(_azimuth(hand.position, arm)))

    def _reach(self, hand: Hand, goal: np.ndarray, aligned: np.ndarray, slack: float = 0.01) -> Waypoint:
        """Return the empty hand on its way; it turns only where it may travel."""
        turn = Rotation.from_matrix(aligned @ hand.rotation.T).magnitude()
        point, travels = self._over(hand, hand.position, goal, turn, slack)
        return Waypoint(point, aligned if travels == 1.0 else downward(hand.yaw), OPEN)

    def _carry(self, hand: Hand, held: np.ndarray, place: np.ndarray, turn: float, slack: float) -> Waypoint:
        """Return something held on its way, turned about the vertical by ``turn`` rad as it travels."""
        point, travels = self._over(hand, held, place, turn, slack)
        turned = travels * float(np.clip(turn, -1.0, 1.0))
        grip = Rotation.from_euler("z", turned).apply(hand.position - held)
        return Waypoint(point + grip, downward(hand.yaw + turned), CLOSED)

    def _over(
        self, hand: Hand, moved: np.ndarray, goal: np.ndarray, turn: float, slack: float
    ) -> tuple[np.ndarray, float]:
        """Return a step of the hand or what it holds: up, then sideways over the walls and round the arm's base, then down.

        Returns:
            f64 [3] where to move it next, m; and how freely it travels sideways, from 0 to 1.
        """
        clearance = max(self.style.hover, _OVER_WALLS + self.style.hover - goal[2])
        start = replace(hand, position=moved)
        point = self.above(start, goal, clearance=clearance, slope=_STEEP, slack=slack, turn=turn)
        missing = min(point[2], _OVER_WALLS) - moved[2]
        travels = float(np.clip(1.25 - missing / 0.04, 0.0, 1.0))
        rising = self._middle(moved) - _BRAKE * hand.velocity[:2]
        point[:2] = travels * point[:2] + (1.0 - travels) * rising
        step = _FIRM * (point - moved)
        step[2] = np.clip(step[2], -_CAREFUL, _CAREFUL)
        if travels > 0.5 and np.linalg.norm(goal[:2] - moved[:2]) > _NEARLY:
            step[:2] = _off_base(moved[:2] + clipped(step[:2], self.style.reach), _SWING) - moved[:2]
        return moved + step, travels

    def _middle(self, moved: np.ndarray) -> np.ndarray:
        """Return f64 [2] m where to rise: the middle of the bin around, if any, or right here."""
        transport = self.sim_env.transport
        for bin_ in (transport.start_bin, transport.target_bin, transport.trash_bin):
            middle, _ = self.body(bin_.root_body)
            if _within(moved, middle):
                return middle[:2]
        return _off_base(moved[:2], _FOLDED)


def _off_base(place: np.ndarray, distance: float) -> np.ndarray:
    """Return f64 [2] the place, moved away from the nearer arm's base where it is within ``distance`` m of it."""
    base = _BASES[int(place[1] > 0)]
    return base + (place - base) * max(1.0, distance / np.linalg.norm(place - base))


def _azimuth(place: np.ndarray, arm: int) -> float:
    """Return the yaw of a hand there that leaves the wrist straight, rad: near the base, others drive it to its limits."""
    away = place[:2] - _BASES[arm]
    return float(np.arctan2(away[1], away[0]))


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _stay(hand: Hand, gripper: float) -> Waypoint:
    return Waypoint(hand.position, hand.rotation, gripper)


def _around(hand: Hand, thing: np.ndarray, width: float) -> bool:
    """Tell whether the fingers are around a thing, closed on it or not yet free of it."""
    return bool(np.linalg.norm(hand.position - thing) < 0.025 and hand.opening < width + _FREE)


def _holds(hand: Hand, thing: np.ndarray, width: float) -> bool:
    return _around(hand, thing, width) and hand.opening < width + 0.004


def _within(thing: np.ndarray, floor: np.ndarray) -> bool:
    """Tell whether a thing is between the walls of the bin with this floor."""
    return bool((np.abs(thing[:2] - floor[:2]) < _ROOM - 0.01).all() and thing[2] < _WALL_TOP)
