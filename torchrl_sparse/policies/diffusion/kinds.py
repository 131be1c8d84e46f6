"""What may be assigned to a policy."""

from __future__ import annotations

from typing import Any

from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["check_kinds", "check_trained_steps"]


def check_kinds(**parts: tuple[Any, type]) -> None:
    """Raise ValueError for the first part that is not of its class.

    Args:
        parts: name -> the part and its class.

    >>> check_kinds(plan=("bac", dict))
    Traceback (most recent call last):
    ...
    ValueError: plan: expected a dict, got str 'bac'
    """
    for name, (part, kind) in parts.items():
        if not isinstance(part, kind):
            got = (
                f"the class {part.__name__}" if isinstance(part, type) else f"{type(part).__name__} {part!r}"
            )
            raise ValueError(f"{name}: expected a {kind.__name__}, got {got}")


def check_trained_steps(own: Sampler, other: Sampler) -> None:
    """Raise ValueError if another sampler counts other training steps than a policy's own: timesteps mean noise levels by them.

    >>> check_trained_steps(Sampler(num_train_timesteps=50), Sampler("ddim", 10))
    Traceback (most recent call last):
    ...
    ValueError: sampler: expected one with num_train_timesteps=50, as the policy was trained, got 100
    """
    if (got := other.num_train_timesteps) != (expected := own.num_train_timesteps):
        raise ValueError(
            f"sampler: expected one with num_train_timesteps={expected}, as the policy was trained, got {got}"
        )
