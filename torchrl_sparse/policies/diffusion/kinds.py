"""Type checks of a policy's assignable parts."""

from __future__ import annotations

from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["check_kinds", "check_trained"]


def check_kinds(**parts: tuple[Any, type]) -> None:
    """Raise InputError for the first part that is not an instance of its class.

    Args:
        parts: name -> the part and its class.

    >>> check_kinds(plan=("bac", dict))
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: plan: expected a dict, got str 'bac'
    """
    for name, (part, kind) in parts.items():
        if not isinstance(part, kind):
            got = (
                f"the class {part.__name__}" if isinstance(part, type) else f"{type(part).__name__} {part!r}"
            )
            raise InputError(f"{name}: expected a {kind.__name__}, got {got}")


def check_trained(sampler: Sampler, own: Sampler) -> None:
    """Raise InputError unless ``sampler`` has the training settings of the policy's ``own``, see `Sampler.trained`."""
    if sampler.trained != own.trained:
        raise InputError(
            f"sampler: expected {own.trained}, with which the policy was trained, got {sampler.trained}; "
            "policy.sampler.variant(...) makes one that fits"
        )
