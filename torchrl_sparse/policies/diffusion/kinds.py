"""What may be assigned to a policy."""

from __future__ import annotations

from typing import Any

__all__ = ["check_kinds"]


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
