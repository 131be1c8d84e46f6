"""Scripted experts: one file a task family, and `make_expert` to get the right one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_sparse.envs.experts.base import Expert
from torchrl_sparse.envs.experts.disturbance import Disturbance
from torchrl_sparse.envs.experts.lift import LiftExpert, LiftMovingExpert
from torchrl_sparse.envs.experts.nut_assembly_square import NutAssemblySquareExpert
from torchrl_sparse.envs.experts.operators import OPERATORS, Operator, Style, draw_operator
from torchrl_sparse.envs.experts.pick_place_can import PickPlaceCanExpert
from torchrl_sparse.envs.experts.tool_hang import ToolHangExpert
from torchrl_sparse.envs.experts.two_arm_transport import TwoArmTransportExpert

EXPERTS: Mapping[str, type[Expert]] = {
    "Lift": LiftExpert,
    "LiftMoving": LiftMovingExpert,
    "LiftNamed": LiftExpert,
    "PickPlaceCan": PickPlaceCanExpert,
    "NutAssemblySquare": NutAssemblySquareExpert,
    "ToolHang": ToolHangExpert,
    "TwoArmTransport": TwoArmTransportExpert,
}
"""The expert of each robosuite task that has one."""


def make_expert(task: str, sim_env: Any, style: Style) -> Expert:
    """The expert of a task for one episode; see `Expert`.

    Raises:
        ValueError: if the task has none; the message lists those that have.
    """
    if task not in EXPERTS:
        raise ValueError(f"task: expected one with an expert ({', '.join(EXPERTS)}), got {task!r}")
    return EXPERTS[task](sim_env, style)


__all__ = [
    "EXPERTS",
    "OPERATORS",
    "Disturbance",
    "Expert",
    "Operator",
    "Style",
    "draw_operator",
    "make_expert",
]
