"""Fine or coarse: how much a motion needs to see, read off the hand's speed.

The action-aware controller of SpecPrune-VLA (arXiv:2509.05614, Eqs. 11 and 12): while the hand moves slowly and not upwards, as
when it closes in on an object, the policy keeps more; in between it is pruned harder. The printed rule switches at a
threshold; here, as in the authors' release, leaving takes more motion than entering did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import action_at

_DELTA_DIM = 7  # three of translation, three of rotation, the gripper


@dataclass(frozen=True)
class Thresholds:
    """Thresholds at which fine mode is entered and left. In m/s and rad/s for measured velocity, in action units for commands.

    Attributes:
        translation, rotation: a hand slower than both, and not rising, enters fine mode.
        leave_translation, leave_rotation, leave_rise: one faster than any of them leaves it.

    Raises:
        ValueError: if one would leave at a motion that enters, which would switch back and forth.
    """

    translation: float
    rotation: float
    leave_translation: float
    leave_rotation: float
    leave_rise: float

    def __post_init__(self) -> None:
        for name in ("translation", "rotation"):
            enter, leave = getattr(self, name), getattr(self, f"leave_{name}")
            if not 0 < enter <= leave:
                raise ValueError(
                    f"{name}: expected 0 < {name} <= leave_{name}, got {name}={enter} and leave_{name}={leave}"
                )
        if self.leave_rise < 0:
            raise ValueError(f"leave_rise: expected at least 0, got {self.leave_rise}")


MEASURED = Thresholds(0.15, 0.3, leave_translation=0.25, leave_rotation=0.6, leave_rise=0.05)
"""A Panda under robosuite's OSC_POSE travels at 0.3 to 0.4 m/s and approaches an object below 0.15 m/s."""

COMMANDED = Thresholds(0.4, 0.2, leave_translation=float("inf"), leave_rotation=0.3, leave_rise=0.2)
"""The numbers of the authors' release, for normalised delta actions."""


def translation_speed(twist: Tensor) -> Tensor:
    """Return Eq. 11: the norm [...] of the first three numbers of ``twist`` [..., 6]."""
    return torch.linalg.vector_norm(twist[..., :3], dim=-1)


def rotation_speed(twist: Tensor) -> Tensor:
    """Return Eq. 12: the norm [...] of the last three numbers of ``twist`` [..., 6]."""
    return torch.linalg.vector_norm(twist[..., 3:], dim=-1)


def fine_mode(twist: Tensor, fine: Tensor, thresholds: Thresholds) -> Tensor:
    """Decide whether the next action is a fine one, bool [*B, 1].

    Args:
        twist: [*B, arms, 6] translation and rotation of each arm. One slow arm enters; it takes all of them to leave.
        fine: bool [*B, 1], whether the last one was.

    Examples:
        >>> slow, rising = torch.tensor([[0.1, 0, -0.02, 0, 0, 0]]), torch.tensor([[0.0, 0, 0.04, 0, 0, 0]])
        >>> coarse = torch.tensor([False])
        >>> [fine_mode(twist, was, MEASURED).item() for twist in (slow, rising) for was in (coarse, ~coarse)]
        [True, True, False, True]
    """
    speed, turn, rise = translation_speed(twist), rotation_speed(twist), twist[..., 2]
    enter = (speed < thresholds.translation) & (turn < thresholds.rotation) & (rise <= 0)
    leave = speed > thresholds.leave_translation
    leave = leave | (turn > thresholds.leave_rotation) | (rise > thresholds.leave_rise)
    return torch.where(fine, ~leave.all(-1, keepdim=True), enter.any(-1, keepdim=True))


class ActionAwareController(TensorDictModuleBase):
    """Switches each sample between coarse and fine, grants the budget of that mode, and re-plans on entering fine.

    The controller of a `ChunkExecutor`: it runs at every step and writes ``("control", "fine")``, the budget, and
    ``("control", "replan")``, which is True where fine mode begins, so that what is left of a chunk that was planned coarsely
    is dropped. State is in keys, per sample, and starts anew where ``"is_init"``.

    Args:
        on: ``"measured"`` reads the hand's velocity, ``("observation", "eef_vel")``; ``"commanded"`` the action served last,
            as the authors' release does, which needs normalised delta actions (7 numbers per arm).
        coarse, fine: the budgets of the two modes. By default tokens per camera, the paper's 24 and 40.
        budget_key: where the budget goes, f32 [*B, 1]; a method that is not about tokens names its own.
        thresholds: by default `MEASURED` or `COMMANDED`.
        warmup_steps: steps at the start of an episode that are coarse whatever happens: the hand has yet to start.

    Raises:
        ValueError: for an unknown ``on``, fewer than one warm-up step, or actions that are not deltas.

    Examples:
        >>> from tensordict import TensorDict
        >>> controller = ActionAwareController(warmup_steps=1)
        >>> td = TensorDict({keys.EEF_VEL: torch.zeros(6), "is_init": torch.tensor([True])}, [])
        >>> controller(td)["control", "fine"].item()
        False
        >>> td = controller(td.set("is_init", torch.tensor([False])))
        >>> td["control", "fine"].item(), td["control", "replan"].item(), td["tokens", "budget"].item()
        (True, True, 40.0)
    """

    def __init__(
        self,
        on: Literal["measured", "commanded"] = "measured",
        *,
        coarse: float = 24.0,
        fine: float = 40.0,
        budget_key: NestedKey = keys.TOKEN_BUDGET,
        thresholds: Thresholds | None = None,
        warmup_steps: int = 10,
    ):
        super().__init__()
        if on not in ("measured", "commanded"):
            raise ValueError(f"on: expected 'measured' or 'commanded', got {on!r}")
        if warmup_steps < 1:
            raise ValueError(f"warmup_steps: expected at least 1, got {warmup_steps}")
        self.on = on
        self.budgets = (float(coarse), float(fine))
        self.thresholds = thresholds or (MEASURED if on == "measured" else COMMANDED)
        self.warmup_steps = warmup_steps
        source = [keys.EEF_VEL] if on == "measured" else [keys.CHUNK, keys.AGE]
        self.in_keys = [keys.IS_INIT, *source, keys.FINE, keys.CONTROL_STEP]
        self.out_keys = [keys.FINE, keys.REPLAN, budget_key, keys.CONTROL_STEP]
        self._budget_key = budget_key

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        init = keys.read(tensordict, keys.IS_INIT)
        step = keys.recall(tensordict, keys.CONTROL_STEP, (1,), 0).masked_fill(init, -1) + 1
        before = keys.recall(tensordict, keys.FINE, (1,), False) & ~init
        twist = self._measured(tensordict) if self.on == "measured" else self._commanded(tensordict)
        fine = fine_mode(twist, before, self.thresholds) & (step >= self.warmup_steps)
        tensordict.set(keys.CONTROL_STEP, step)
        tensordict.set(keys.FINE, fine)
        tensordict.set(keys.REPLAN, fine & ~before)
        coarse_budget, fine_budget = twist.new_tensor(self.budgets)
        return tensordict.set(self._budget_key, torch.where(fine, fine_budget, coarse_budget))

    @staticmethod
    def _measured(tensordict: TensorDictBase) -> Tensor:
        """Read the velocity of each arm, [*B, arms, 6]."""
        velocity = keys.read(tensordict, keys.EEF_VEL)
        if velocity.shape[-1] % 6:
            raise ValueError(f"{keys.EEF_VEL}: expected 6 numbers per arm, got {velocity.shape[-1]}")
        return velocity.unflatten(-1, (-1, 6))

    @staticmethod
    def _commanded(tensordict: TensorDictBase) -> Tensor:
        """Read the twist that the last action commanded of each arm, [*B, arms, 6]; zero before the first."""
        chunk = keys.recall(tensordict, keys.CHUNK, (1, _DELTA_DIM), 0.0)
        if chunk.shape[-1] % _DELTA_DIM:
            raise ValueError(
                f"{keys.CHUNK}: on='commanded' expects delta actions, {_DELTA_DIM} numbers per arm, got "
                f"{chunk.shape[-1]}; use on='measured'"
            )
        action = action_at(chunk, keys.recall(tensordict, keys.AGE, (1,), 0))
        return action.unflatten(-1, (-1, _DELTA_DIM))[..., :6]
