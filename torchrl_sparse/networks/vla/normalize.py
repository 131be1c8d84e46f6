"""Quantile normalisation of states and actions, as OpenVLA-OFT (arXiv:2502.19645) does it for LIBERO."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.normalize import MIN_RANGE

__all__ = ["QuantileNormalizer"]

_EPS = 1e-8
_RARE = 100
"""A channel whose whole range is so many times that between its quantiles is used rarely."""


class QuantileNormalizer(nn.Module):
    """Normaliser that maps the range from the 1 % to the 99 % quantile to [-1, 1], per dimension.

    Both are clipped to [-1, 1]. Gripper dimensions have no range: the policy says how open the gripper shall be, from 0
    (closed) to 1, the environment takes -1 (open) or 1 (close). What varies by less than 1e-4 is centred and not stretched, as
    by `torchrl_sparse.networks.normalize.Normalizer`: the policy would see its rounding. Such an action stays within its range.

    Args:
        state_low, state_high: f32 [Ds], the quantiles.
        action_low, action_high: f32 [A].
        gripper: bool [A], which actions are grippers.

    Raises:
        InputError: if shapes differ, a number is not finite, or a high quantile is below a low one.

    Examples:
        >>> low, high = torch.zeros(2), torch.tensor([4.0, 1.0])
        >>> normalizer = QuantileNormalizer(low, high, low, high, torch.tensor([False, True]))
        >>> normalizer.normalize_state(torch.tensor([3.0, 9.0])).tolist()
        [0.5, 1.0]
        >>> normalizer.unnormalize_action(torch.tensor([0.5, 0.9])).tolist()
        [3.0, -1.0]
    """

    def __init__(
        self, state_low: Tensor, state_high: Tensor, action_low: Tensor, action_high: Tensor, gripper: Tensor
    ):
        super().__init__()
        _check_range("state", state_low, state_high)
        _check_range("action", action_low, action_high)
        if gripper.dtype != torch.bool or gripper.shape != action_low.shape:
            raise InputError(
                f"gripper: expected bool {list(action_low.shape)}, got {gripper.dtype} {list(gripper.shape)}"
            )
        self.register_buffer("state_low", state_low.float().clone())
        self.register_buffer("state_high", state_high.float().clone())
        self.register_buffer("action_low", action_low.float().clone())
        self.register_buffer("action_high", action_high.float().clone())
        self.register_buffer("gripper", gripper)

    @classmethod
    def identity(cls, state_dim: int, action_dim: int) -> QuantileNormalizer:
        """Return a normaliser that leaves actions, and states between -1 and 1, unchanged."""
        state, action = torch.ones(state_dim), torch.ones(action_dim)
        return cls(-state, state, -action, action, torch.zeros(action_dim, dtype=torch.bool))

    @classmethod
    def fit(cls, state: Tensor, action: Tensor, *, gripper: Sequence[int] = (6,)) -> QuantileNormalizer:
        """Fit a normaliser to states [N, Ds] and actions [N, A], whose ``gripper`` dimensions are -1 (open) to 1 (close).

        Beyond the quantiles no output can command. An action that is used so rarely that they leave out 99 % of its
        range, such as a turn in 5 of 1,000 steps, is mapped by its least and its largest number instead, with a warning.
        """
        is_gripper = torch.zeros(action.shape[1], dtype=torch.bool)
        is_gripper[list(gripper)] = True
        low, high = _quantiles(action)
        least, largest = action.double().amin(0), action.double().amax(0)
        rare = (largest - least >= MIN_RANGE) & (largest - least > _RARE * (high - low)) & ~is_gripper
        if rare.any():
            warnings.warn(
                f"action: numbers {', '.join(map(str, rare.nonzero().flatten().tolist()))} vary in a few steps alone; they are "
                "normalised by their least and largest values, not by their quantiles, so that they can still be commanded",
                stacklevel=2,
            )
        low, high = torch.where(rare, least, low), torch.where(rare, largest, high)
        return cls(*_quantiles(state), low, high, is_gripper)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Map states [..., Ds] from environment units to the policy's."""
        return _to_unit(state, self.state_low, self.state_high).clamp(-1, 1)

    def normalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] from environment units to the policy's."""
        unit = _to_unit(action, self.action_low, self.action_high)
        return torch.where(self.gripper, (1 - action) / 2, unit.clamp(-1, 1))

    def unnormalize_action(self, action: Tensor) -> Tensor:
        """Map actions [..., A] from the policy's to environment units; grippers become -1 or 1, 0 exactly between."""
        real = (action + 1) / 2 * (self.action_high - self.action_low + _EPS) + self.action_low
        return torch.where(self.gripper, (1 - 2 * action).sign(), real)


def _quantiles(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the 1 % and the 99 % quantile of each column."""
    return torch.quantile(x.double(), 0.01, dim=0), torch.quantile(x.double(), 0.99, dim=0)


def _to_unit(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    stretched = 2 * (x - low) / (high - low + _EPS) - 1
    return torch.where(high - low < MIN_RANGE, x - (high + low) / 2, stretched)


def _check_range(name: str, low: Tensor, high: Tensor) -> None:
    if low.ndim != 1 or low.shape != high.shape:
        raise InputError(
            f"{name}: expected two vectors of one size, got {list(low.shape)} and {list(high.shape)}"
        )
    if not (low.isfinite().all() and high.isfinite().all() and (low <= high).all()):
        raise InputError(
            f"{name}: expected finite quantiles with low <= high, got {low.tolist()}, {high.tolist()}"
        )
