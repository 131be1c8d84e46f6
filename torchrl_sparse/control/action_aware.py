"""Action-aware control: fine or coarse mode, chosen from the hand's speed.

The action-aware controller of SpecPrune-VLA (arXiv:2509.05614, Eqs. 11 and 12): while the hand moves slowly and not upwards, as
when it closes in on an object, the policy keeps more; in between it is pruned harder. The printed rule switches at a
threshold; here leaving takes more motion than entering did. The rule of the authors' release, which reads commanded actions and
is another one, is `ReleaseThresholds`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import COUNT, FLAG, Entry
from torchrl_sparse.control.chunk_executor import action_at
from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import parse_json

_DELTA_DIM = 7  # three of translation, three of rotation, the gripper


@dataclass(frozen=True)
class Thresholds:
    """Thresholds for entering and leaving fine mode: m/s and rad/s for measured velocity, action units for commands.

    Attributes:
        translation, rotation: a hand slower than both, and not rising, enters fine mode.
        leave_translation, leave_rotation, leave_rise: one faster than any of them leaves it.

    Raises:
        InputError: if one would leave at a motion that enters, which would switch back and forth.
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
                raise InputError(
                    f"{name}: expected 0 < {name} <= leave_{name}, got {name}={enter} and leave_{name}={leave}"
                )
        if self.leave_rise < 0:
            raise InputError(f"leave_rise: expected at least 0, got {self.leave_rise}")

    def enters(self, twist: Tensor) -> Tensor:
        """Tell, bool [...], whether a motion [..., 6] enters fine mode."""
        slow = (translation_speed(twist) < self.translation) & (rotation_speed(twist) < self.rotation)
        return slow & (twist[..., 2] <= 0)

    def leaves(self, twist: Tensor, used_up: Tensor) -> Tensor:
        """Tell, bool [...], whether a motion [..., 6] leaves fine mode; ``used_up`` is ignored."""
        fast = (translation_speed(twist) > self.leave_translation) | (
            rotation_speed(twist) > self.leave_rotation
        )
        return fast | (twist[..., 2] > self.leave_rise)


@dataclass(frozen=True)
class ReleaseThresholds:
    """Rule of the authors' release for normalised delta actions; it reads the last executed action.

    Entering takes a slow translation, whatever the rotation and the rise, *or* a motion that is slow in the plane, does not
    rise fast and turns slowly. A rise leaves, and so does a fast rotation in the last action of a chunk. So a motion may enter
    and leave at once, and a slow rise alternates.

    Attributes:
        speed: of translation, below which fine mode is entered.
        planar_speed, rise, rotation: below which all three it is entered as well.
        leave_rise: above which it is left.
        leave_rotation: above which it is left where the chunk is used up.
    """

    speed: float = 0.4
    planar_speed: float = 0.1
    rise: float = 0.1
    rotation: float = 0.2
    leave_rise: float = 0.2
    leave_rotation: float = 0.3

    def enters(self, twist: Tensor) -> Tensor:
        """Tell, bool [...], whether a motion [..., 6] enters fine mode."""
        planar = torch.linalg.vector_norm(twist[..., :2], dim=-1) < self.planar_speed
        calm = planar & (twist[..., 2] < self.rise) & (rotation_speed(twist) < self.rotation)
        return (translation_speed(twist) < self.speed) | calm

    def leaves(self, twist: Tensor, used_up: Tensor) -> Tensor:
        """Tell, bool [..., arms], whether a motion [..., arms, 6] leaves fine mode; ``used_up``, bool [..., 1]: at a chunk's
        end.
        """
        turning = rotation_speed(twist) > self.leave_rotation
        return (twist[..., 2] > self.leave_rise) | (turning & used_up)


MEASURED = Thresholds(0.15, 0.3, leave_translation=0.25, leave_rotation=0.6, leave_rise=0.05)
"""A Panda under robosuite's OSC_POSE travels at 0.3 to 0.4 m/s and approaches an object below 0.15 m/s."""

COMMANDED = ReleaseThresholds()
"""The authors' release, for normalised delta actions. With ``warmup_steps=11`` it begins where the release does."""


def translation_speed(twist: Tensor) -> Tensor:
    """Return the norm [...] of the first three numbers of ``twist`` [..., 6] (Eq. 11)."""
    return torch.linalg.vector_norm(twist[..., :3], dim=-1)


def rotation_speed(twist: Tensor) -> Tensor:
    """Return the norm [...] of the last three numbers of ``twist`` [..., 6] (Eq. 12)."""
    return torch.linalg.vector_norm(twist[..., 3:], dim=-1)


def fine_mode(
    twist: Tensor,
    fine: Tensor,
    thresholds: Thresholds | ReleaseThresholds,
    used_up: Tensor | None = None,
) -> Tensor:
    """Decide whether the next action is in fine mode, bool [*B, 1].

    Args:
        twist: [*B, arms, 6] translation and rotation of each arm. One slow arm enters; it takes all of them to leave.
        fine: bool [*B, 1], whether the last one was.
        thresholds: of either rule.
        used_up: bool [*B, 1], whether the last action was the last of its chunk; None for none of them.

    Examples:
        >>> slow, rising = torch.tensor([[0.1, 0, -0.02, 0, 0, 0]]), torch.tensor([[0.0, 0, 0.04, 0, 0, 0]])
        >>> coarse = torch.tensor([False])
        >>> [fine_mode(twist, was, MEASURED).item() for twist in (slow, rising) for was in (coarse, ~coarse)]
        [True, True, False, True]
    """
    leave = thresholds.leaves(twist, torch.zeros_like(fine) if used_up is None else used_up)
    enter = thresholds.enters(twist)
    return torch.where(fine, ~leave.all(-1, keepdim=True), enter.any(-1, keepdim=True))


@dataclass(frozen=True)
class ControllerOptions:
    """Recipe options of an `ActionAwareController`; its ``on`` is named ``motion``, since YAML reads ``on`` as a
    truth value.
    """

    motion: Literal["measured", "commanded"] = "measured"
    coarse: float = 24.0
    fine: float = 40.0
    thresholds: Thresholds | ReleaseThresholds | None = None
    warmup_steps: int = 10
    chunk_steps: int | None = None


class ActionAwareController(TensorDictModuleBase):
    """Controller that switches each sample between coarse and fine, sets that mode's budget, and replans on entering fine.

    The controller of a `ChunkExecutor`: it runs at every step and writes ``("control", "fine")``, the budget, and
    ``("control", "replan")``, which is True where fine mode begins, so that the rest of a coarsely planned chunk is dropped.
    State is in keys, per sample, and starts again where ``"is_init"``.

    Args:
        on: ``"measured"`` reads the hand's velocity, ``("observation", "eef_vel")``; ``"commanded"`` the action served last,
            as the authors' release does, which needs normalised delta actions (7 numbers per arm).
        coarse, fine: the budgets of the two modes. By default tokens per camera, the paper's 24 and 40.
        budget_key: where the budget goes, f32 [*B, 1]; a method that is not about tokens names its own.
        thresholds: by default `MEASURED` or `COMMANDED`; those of the release need ``on="commanded"``.
        warmup_steps: steps at the start of an episode that are coarse whatever happens: the hand has yet to start.
        chunk_steps: actions of a chunk that are executed, after which the release leaves fine mode by a rotation; None for all
            of them.

    Raises:
        InputError: for an unknown ``on``, thresholds that are not for it, fewer than one warm-up step, or actions that are not
            deltas.

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
        thresholds: Thresholds | ReleaseThresholds | None = None,
        warmup_steps: int = 10,
        chunk_steps: int | None = None,
    ):
        super().__init__()
        if on not in ("measured", "commanded"):
            raise InputError(f"on: expected 'measured' or 'commanded', got {on!r}")
        if warmup_steps < 1:
            raise InputError(f"warmup_steps: expected at least 1, got {warmup_steps}")
        if on == "measured" and isinstance(thresholds, ReleaseThresholds):
            raise InputError("thresholds: expected Thresholds with on='measured', got ReleaseThresholds")
        self.on = on
        self.chunk_steps = chunk_steps
        self.budgets = (float(coarse), float(fine))
        self.thresholds = thresholds or (MEASURED if on == "measured" else COMMANDED)
        self.warmup_steps = warmup_steps
        source = [keys.EEF_VEL] if on == "measured" else [keys.CHUNK, keys.AGE]
        self.in_keys = [keys.IS_INIT, *source, keys.FINE, keys.CONTROL_STEP]
        self.out_keys = [keys.FINE, keys.REPLAN, budget_key, keys.CONTROL_STEP]
        self._budget_key = budget_key

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the keys carried for one environment, see :mod:`torchrl_sparse.carried`."""
        return {keys.FINE: FLAG, keys.CONTROL_STEP: COUNT}

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        init = keys.read(tensordict, keys.IS_INIT)
        step = keys.recall(tensordict, keys.CONTROL_STEP, (1,), 0).masked_fill(init, -1) + 1
        before = keys.recall(tensordict, keys.FINE, (1,), False) & ~init
        if self.on == "measured":
            twist, used_up = self._measured(tensordict), None
        else:
            twist, used_up = self._commanded(tensordict)
        fine = fine_mode(twist, before, self.thresholds, used_up) & (step >= self.warmup_steps)
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
            raise InputError(f"{keys.EEF_VEL}: expected 6 numbers per arm, got {velocity.shape[-1]}")
        return velocity.unflatten(-1, (-1, 6))

    @classmethod
    def from_options(cls, **options: Any) -> ActionAwareController:
        """Build a controller from plain values, as in a recipe's section ``controller``; see `ControllerOptions`.

        Raises:
            InputError: ``controller: key: expected …, got …``.

        Examples:
            >>> ActionAwareController.from_options(fine=36.0).budgets
            (24.0, 36.0)
            >>> ActionAwareController.from_options(fin=36.0)
            Traceback (most recent call last):
            ...
            torchrl_sparse.errors.InputError: controller: fin: expected no such key, got 36.0
        """
        found = vars(parse_json(json.dumps(options), ControllerOptions, "controller"))
        return cls(found.pop("motion"), **found)

    def _commanded(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Read the twist that the last action commanded of each arm, [*B, arms, 6], zero before the first; and bool [*B, 1],
        whether it was the last of its chunk.
        """
        chunk = keys.recall(tensordict, keys.CHUNK, (1, _DELTA_DIM), 0.0)
        if chunk.shape[-1] % _DELTA_DIM:
            raise InputError(
                f"{keys.CHUNK}: on='commanded' expects delta actions, {_DELTA_DIM} numbers per arm, got "
                f"{chunk.shape[-1]}; use on='measured'"
            )
        age = keys.recall(tensordict, keys.AGE, (1,), 0).clamp(min=0)
        used_up = age + 1 >= (self.chunk_steps or chunk.shape[-2])
        return action_at(chunk, age).unflatten(-1, (-1, _DELTA_DIM))[..., :6], used_up
