"""Number of verdicts in a ``results.json``, and those that survive the correction for multiple comparisons."""

from __future__ import annotations

from collections.abc import Mapping

from torchrl_sparse.evaluation.results.parts import PValues
from torchrl_sparse.evaluation.results.schema import Results
from torchrl_sparse.evaluation.statistics.multiplicity import holm

__all__ = ["num_comparisons", "survivors", "surviving"]


def num_comparisons(results: Results) -> int:
    """Return the number of verdicts: on success and time, or on the score alone, for every method but dense."""
    return (1 if results.graded else 2) * (len(results.methods) - 1)


def survivors(results: Results) -> set[str]:
    """Return which verdicts, as ``"NAME success"`` and ``"NAME time"``, survive Holm's correction."""
    if results.graded:
        scores = {name: method.score.p_value for name, method in results.methods.items()}
        p_values = {f"{name} success": p for name, p in scores.items() if p is not None}
        return holm(p_values, num_comparisons(results))
    p_values = {name: method.p_values for name, method in results.methods.items()}
    return surviving(p_values, num_comparisons(results))


def surviving(p_values: Mapping[str, PValues | None], comparisons: int) -> set[str]:
    """Return which verdicts, as ``"NAME success"`` and ``"NAME time"``, survive Holm's correction.

    Args:
        p_values: name -> of both its verdicts; None of dense.
        comparisons: verdicts in the family.
    """
    tested = {name: p for name, p in p_values.items() if p is not None}
    both = {f"{name} success": p.success for name, p in tested.items()}
    return holm(both | {f"{name} time": p.time for name, p in tested.items()}, comparisons)
