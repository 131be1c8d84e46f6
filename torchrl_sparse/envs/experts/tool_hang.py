"""ToolHang: stand the frame in the stand's hole, then hang the wrench on the frame's hook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Hand, Waypoint, at, downward

_UP = np.array([0.0, 0.0, 1.0])
_FRAME_GRIP = np.array([0.04375, 0.0, 0.0525])  # m, the grip's centre in the frame's axes
_FRAME_TIP = np.array([0.04375, 0.0, -0.13445])
_FRAME_HOOK = np.array([-0.04375, 0.0, 0.08625])  # the corner of arm and upturned end, at half thickness
_FRAME_WIDTH = 0.0254
_TOOL_HOLE = np.array([-0.0936, 0.0, 0.0])
_TOOL_WIDTH = 0.03
_LEAN_TOOL = 0.0
_LEAN = np.pi / 4  # rad to the vertical of the hand that grasps either


@dataclass(frozen=True)
class Pose:
    position: np.ndarray
    rotation: np.ndarray

    def point(self, local):
        return self.position + self.rotation @ local


class ToolHangExpert(Expert):
    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        frame = Pose(*self.body(self.sim_env.frame.root_body))
        tool = Pose(*self.body(self.sim_env.tool.root_body))
        hole = self._hole()
        if not self._assembled(frame, hole):
            self.phase = "frame"
            return [self._assemble(hand, frame, hole)]
        return [self._hang(hand, frame, tool)]

    def _hole(self):
        position, rotation = self.body(self.sim_env.stand.root_body)
        return position + rotation @ np.array([0.0, 0.045, 0.08])

    def _assembled(self, frame, hole):
        tip = frame.point(_FRAME_TIP) - hole
        return np.linalg.norm(tip[:2]) < 0.007 and tip[2] < -0.145

    # -- the frame

    def _assemble(self, hand, frame, hole):
        grip = frame.point(_FRAME_GRIP)
        aligned = frame.rotation @ _frame_grasp()
        if self._between(hand, frame) and abs(hand.opening - _FRAME_WIDTH) < 0.004:
            self.phase = "carry frame"
            return self._insert(hand, frame, hole)
        if at(hand, grip, aligned, position=0.01):
            self.phase = "close frame"
            return Waypoint(grip, aligned, CLOSED)
        self.phase = "approach frame"
        return Waypoint(self.above(hand, grip), aligned, OPEN, 0.7)

    def _between(self, hand, frame):
        local = frame.rotation.T @ (hand.position - frame.point(_FRAME_GRIP))
        return abs(local[2]) < 0.032 and np.linalg.norm(local[:2]) < 0.022

    def _insert(self, hand, frame, hole):
        tip = frame.point(_FRAME_TIP)
        upright = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turn = Rotation.from_matrix(upright @ frame.rotation.T)
        angle = turn.magnitude()
        off = tip - hole
        inside = off[2] < -0.005 and np.abs(off[:2]).max() < 0.0055
        up = frame.rotation[:, 2]
        goal = hole.copy()
        if inside:
            rim = np.abs(off[:2] - up[:2] * off[2] / up[2]).max()  # of the rod's axis, where the hole begins
            fit = 0.001 if off[2] > -0.05 else 0.002
            goal[2] = tip[2] - np.clip(0.015 - 30 * max(0.0, rim - fit), -0.01, 0.015)
            free, pace = 1.0, 0.4
        else:
            rim = 0
            error = max(np.linalg.norm(off[:2] + s * hand.velocity[:2]) for s in (0.0, 0.1)) 
            misfit = error + 0.03 * angle
            slack = max(0.0, misfit - 0.003)
            goal[2] += np.clip(-0.015 + 10 * slack, -0.015, 0.02)
            over = np.clip(off[2] / 0.02, 0.0, 1.0)
            free = np.clip((tip[2] - 0.84) / 0.05, 0.0, 1.0)
            pace = 0.4 if misfit < 0.08 else 0.8
        part = Rotation.from_rotvec(free * turn.as_rotvec())
        position = goal + turn.apply(hand.position - tip)
        if not inside:
            position[:2] = hand.position[:2] + over * (position - hand.position)[:2]
        self.phase += f" ang {angle:.2f} rim {rim:.4f} tip {tip-hole} in {inside} tilt {hand.tilt:.2f} yaw {hand.yaw:.2f}"
        return Waypoint(position, part.as_matrix() @ hand.rotation, CLOSED, pace)

    # -- the tool

    def _hang(self, hand, frame, tool):
        out = self._axes(frame)[0] @ (tool.point(_TOOL_HOLE) - frame.point(_FRAME_HOOK))
        if self._around(frame, tool) and out < -0.012:
            self.phase = "let go"
            back = -hand.rotation[:, 2] * (0.15 if hand.opening > 0.04 else 0)
            return Waypoint(hand.position + back, hand.rotation, OPEN, 0.5)
        if np.linalg.norm(hand.position - tool.position) < 0.025 and abs(hand.opening - _TOOL_WIDTH) < 0.004:
            self.phase = "carry tool"
            return self._thread(hand, frame, tool)
        grip = frame.point(_FRAME_GRIP)
        if np.linalg.norm(hand.position - grip) < 0.16:
            self.phase = "leave frame"
            back = -hand.rotation[:, 2]
            return Waypoint(hand.position + (0.15 if hand.opening > 0.035 else 0) * back, hand.rotation, OPEN)
        aligned = tool.rotation @ _tool_grasp()
        if at(hand, tool.position, aligned, position=0.01):
            self.phase = "close tool"
            return Waypoint(tool.position, aligned, CLOSED)
        self.phase = "approach tool"
        near = np.linalg.norm(hand.position - frame.point(_FRAME_HOOK)) < 0.2
        left = Rotation.from_matrix(aligned @ hand.rotation.T).magnitude()
        return Waypoint(self.above(hand, tool.position, turn=left), downward(hand.yaw) if near else aligned, OPEN, 0.7)

    def _thread(self, hand, frame, tool):
        axes = self._axes(frame)
        out, side, up = axes @ (tool.point(_TOOL_HOLE) - frame.point(_FRAME_HOOK))
        if self._around(frame, tool):
            s = -out - max(up, 0.0) + 0.008
            goal = np.array([-max(s, 0.0) , 0.0, max(-s, 0.0)])
            if abs(s) < 0.003:
                goal = np.array([-(0.003 + s) / 2, 0.0, (0.003 - s) / 2])
            pitch, pace = np.interp(s, [-0.02, -0.004, 0.006, 0.02], np.radians([25, 40, 50, 65])), 0.3
            position, turn = self._carried(hand, frame, tool, goal, pitch)
        else:
            slack = max(0.0, float(np.hypot(out, side)) - 0.003)
            pitch, pace = np.radians(25), 0.7
            goal = np.array([0.0, 0.0, min(0.01 + 10 * slack, 0.05)])
            position, turn = self._carried(hand, frame, tool, goal, pitch)
            over = np.clip((up - 0.015) / 0.01, 0.0, 1.0)
            position[:2] = hand.position[:2] + over * (position - hand.position)[:2]
            if slack < 0.02:
                pace = 0.3
        self.phase += f" out {out:.4f} side {side:.4f} up {up:.4f} ang {turn.magnitude():.3f} pitch {pitch:.2f} around {self._around(frame, tool)}"
        return Waypoint(position, turn.as_matrix() @ hand.rotation, CLOSED, pace)

    def _axes(self, frame):
        return np.stack([-frame.rotation[:, 0], frame.rotation[:, 1], frame.rotation[:, 2]])  # outward, sideways, up

    def _around(self, frame, tool):
        out, side, up = self._axes(frame) @ (tool.point(_TOOL_HOLE) - frame.point(_FRAME_HOOK))
        tip = -0.008 < up < 0.017 and abs(out) < 0.008
        arm = out < 0 and abs(up) < 0.009
        return abs(side) < 0.007 and (tip or arm)

    def _carried(self, hand, frame, tool, goal, pitch):
        axes = self._axes(frame)
        z = axes.T @ np.array([np.sin(pitch), 0, np.cos(pitch)])
        x = axes.T @ np.array([np.cos(pitch), 0, -np.sin(pitch)])
        rotation = np.stack([x, np.cross(z, x), z], axis=1)
        turn = Rotation.from_matrix(rotation @ tool.rotation.T)
        position = frame.point(_FRAME_HOOK) + axes.T @ goal + turn.apply(hand.position - tool.point(_TOOL_HOLE))
        return position, turn


def _frame_grasp():
    """a = y cos - z sin."""
    c, s = np.cos(_LEAN), np.sin(_LEAN)
    z = np.array([0.0, c, -s])
    y = np.array([0.0, -s, -c])
    return np.stack([np.cross(y, z), y, z], axis=1)


def _tool_grasp():
    c, s = np.cos(_LEAN_TOOL), np.sin(_LEAN_TOOL)
    z = np.array([s, 0.0, -c])
    y = np.array([-c, 0.0, -s])
    return np.stack([np.cross(y, z), y, z], axis=1)
