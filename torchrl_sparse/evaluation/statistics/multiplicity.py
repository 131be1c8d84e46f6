"""Correction for multiple comparisons in one table."""

from __future__ import annotations

from collections.abc import Mapping

from torchrl_sparse.errors import InputError

__all__ = ["ONE_SIDED_ERROR", "holm"]

ONE_SIDED_ERROR = 0.025  # of a verdict, the tail of a 95 % interval


def holm(
    p_values: Mapping[str, float], comparisons: int | None = None, error: float = ONE_SIDED_ERROR
) -> set[str]:
    """Return the names whose p-values survive Holm's correction (S. Holm, Scand. J. Statistics 6, 1979).

    The smallest must be below ``error / comparisons``, the next below ``error / (comparisons - 1)``, and so on until one is
    not; all verdicts that survive are then right together with probability ``1 - error`` at least.

    Args:
        p_values: name -> one-sided p-value.
        comparisons: in the family, those included that have no p-value here; as many as p-values by default.
        error: of the whole family.

    Raises:
        InputError: if there are fewer comparisons than p-values, or a p-value is none.

    >>> sorted(holm({"a": 0.001, "b": 0.012, "c": 0.02}))
    ['a', 'b', 'c']
    >>> sorted(holm({"a": 0.001, "b": 0.012, "c": 0.02}, comparisons=5))
    ['a']
    """
    family = len(p_values) if comparisons is None else comparisons
    if family < len(p_values):
        raise InputError(f"comparisons: expected at least {len(p_values)}, got {family}")
    for name, p in p_values.items():
        if not 0 <= p <= 1:
            raise InputError(f"{name}: expected a p-value of 0 to 1, got {p}")
    survivors: set[str] = set()
    for name, p in sorted(p_values.items(), key=lambda entry: entry[1]):
        if p > error / (family - len(survivors)):
            break
        survivors.add(name)
    return survivors
