"""Affine maps between environment units and policy units, as published for Diffusion Policy.

Absolute-pose actions (arXiv:2303.04137, robomimic tasks): positions are range-normalised to [-1, 1] per
dimension, the 6-D rotation and the gripper, already in that range, are kept. Low-dimensional states: one
scale for all dimensions, no offset, so that the largest magnitude becomes 1.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import ABSOLUTE_DIM

__all__ = ["MIN_RANGE", "Normalizer", "ShiftedNormalizer"]

_POSITION = slice(0, 3)
MIN_RANGE = 1e-4
"""Dimensions that vary less are centred and not stretched: dividing by their range would amplify noise."""


class Normalizer(nn.Module):
    """Normaliser of states and actions, ``normalised = x * scale + offset``; the four tensors are buffers.

    Args:
        state_scale, state_offset: f32 [Ds].
        action_scale, action_offset: f32 [A].

    Raises:
        InputError: if a scale and its offset differ in shape, are not vectors, or are not finite, or if a
            scale has a zero.

    Examples:
        >>> state = torch.tensor([[0.5, -2.0], [1.0, 1.0]])
        >>> action = torch.zeros(2, 10)
        >>> action[1, 0] = 0.4
        >>> normalizer = Normalizer.fit(state, action)
        >>> normalizer.normalize_state(state)[0].tolist()
        [0.25, -1.0]
        >>> normalizer.normalize_action(action)[:, 0].tolist()
        [-1.0, 1.0]
    """

    def __init__(
        self, state_scale: Tensor, state_offset: Tensor, action_scale: Tensor, action_offset: Tensor
    ) -> None:
        super().__init__()
        _check_pair("state", state_scale, state_offset)
        _check_pair("action", action_scale, action_offset)
        self.register_buffer("state_scale", state_scale.float())
        self.register_buffer("state_offset", state_offset.float())
        self.register_buffer("action_scale", action_scale.float())
        self.register_buffer("action_offset", action_offset.float())

    @classmethod
    def fit(
        cls,
        state: Tensor,
        action: Tensor,
        *,
        state_mode: Literal["global", "range"] = "global",
        poses: bool = True,
    ) -> Normalizer:
        """Fit a normaliser to a data set.

        Args:
            state: [N, Ds].
            action: [N, A].
            state_mode: ``"global"`` is the published choice, one scale for all dimensions; ``"range"`` maps
                each dimension to [-1, 1], which short trainings need: in metres, objects move by a few
                hundredths.
            poses: actions are absolute poses, A = 10 * arms; False maps each of their dimensions to [-1, 1], as published
                for the benchmarks outside robosuite.

        Raises:
            InputError: if the shapes do not fit, a value is not finite or ``state_mode`` is unknown.
        """
        _check_data(state, action, poses)
        if state_mode == "global":
            scale = state.abs().max().clamp(min=MIN_RANGE).reciprocal().expand(state.shape[1])
            offset = torch.zeros_like(scale)
        elif state_mode == "range":
            scale, offset = _range_map(state)
        else:
            raise InputError(f'state_mode: expected "global" or "range", got {state_mode!r}')
        return cls(scale.clone(), offset.clone(), *(_pose_map(action) if poses else _range_map(action)))

    def state_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest states [Ds] that are mapped to [-1, 1], in environment units."""
        return (-1 - self.state_offset) / self.state_scale, (1 - self.state_offset) / self.state_scale

    def normalize_state(self, state: Tensor) -> Tensor:
        """Map states [..., Ds] from environment units to the policy's."""
        return state * self.state_scale + self.state_offset

    def normalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] from environment units to the policy's."""
        return action * self.action_scale + self.action_offset

    def unnormalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] from the policy's units to environment units."""
        return (action - self.action_offset) / self.action_scale


class ShiftedNormalizer(Normalizer):
    """``normalised = (x - shift) * scale + offset``, for statistics of dimensions that hardly vary.

    Where a range is 1e-8, as LeRobot's normalisers have it for a constant, ``x * scale`` has lost x before the offset comes.

    Args:
        state_scale, state_offset, state_shift: f32 [Ds].
        action_scale, action_offset, action_shift: f32 [A].

    Examples:
        >>> constant, one, zero = torch.full((1,), 0.3), torch.ones(1), torch.zeros(1)
        >>> ShiftedNormalizer(one * 2e8, -one, one, zero, state_shift=constant, action_shift=zero).normalize_state(constant)
        tensor([-1.])
    """

    def __init__(
        self,
        state_scale: Tensor,
        state_offset: Tensor,
        action_scale: Tensor,
        action_offset: Tensor,
        *,
        state_shift: Tensor,
        action_shift: Tensor,
    ) -> None:
        super().__init__(state_scale, state_offset, action_scale, action_offset)
        _check_pair("state", state_scale, state_shift)
        _check_pair("action", action_scale, action_shift)
        self.register_buffer("state_shift", state_shift.float())
        self.register_buffer("action_shift", action_shift.float())

    def state_range(self) -> tuple[Tensor, Tensor]:
        """See `Normalizer.state_range`."""
        low, high = super().state_range()
        return low + self.state_shift, high + self.state_shift

    def normalize_state(self, state: Tensor) -> Tensor:
        """Map states [..., Ds] in environment units to the policy's."""
        return super().normalize_state(state - self.state_shift)

    def normalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] in environment units to the policy's."""
        return super().normalize_action(action - self.action_shift)

    def unnormalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] of the policy to environment units."""
        return super().unnormalize_action(action) + self.action_shift


def _pose_map(action: Tensor) -> tuple[Tensor, Tensor]:
    """Scale and offset [10 * arms]: range for positions, identity for rotation and gripper."""
    arms = action.reshape(action.shape[0], -1, ABSOLUTE_DIM)
    scale, offset = torch.ones(arms.shape[1:]), torch.zeros(arms.shape[1:])
    for arm in range(arms.shape[1]):
        scale[arm, _POSITION], offset[arm, _POSITION] = _range_map(arms[:, arm, _POSITION])
    return scale.flatten(), offset.flatten()


def _range_map(x: Tensor) -> tuple[Tensor, Tensor]:
    """Scale and offset that send each column's minimum to -1 and maximum to 1."""
    low, high = x.amin(0), x.amax(0)
    extent = high - low
    scale = torch.where(extent < MIN_RANGE, torch.ones_like(extent), 2 / extent.clamp(min=MIN_RANGE))
    return scale, -(high + low) / 2 * scale


def _check_data(state: Tensor, action: Tensor, poses: bool) -> None:
    if state.ndim != 2 or action.ndim != 2 or len(state) != len(action) or not len(state):
        raise InputError(
            f"state, action: expected [N, Ds] and [N, A], N > 0, got {list(state.shape)}, {list(action.shape)}"
        )
    if poses and action.shape[1] % ABSOLUTE_DIM:
        raise InputError(
            f"action: expected {ABSOLUTE_DIM} numbers per arm, got a last axis of {action.shape[1]}"
        )
    for name, value in (("state", state), ("action", action)):
        if not value.isfinite().all():
            raise InputError(f"{name}: expected finite numbers, got {value[~value.isfinite()][0].item()}")


def _check_pair(name: str, scale: Tensor, offset: Tensor) -> None:
    if scale.ndim != 1 or scale.shape != offset.shape:
        raise InputError(
            f"{name}_scale, {name}_offset: expected vectors of one size, "
            f"got {list(scale.shape)} and {list(offset.shape)}"
        )
    if not (scale.isfinite().all() and offset.isfinite().all() and (scale != 0).all()):
        raise InputError(f"{name}_scale, {name}_offset: expected finite numbers and a scale without zeros")
