"""Recommendations from a ``results.json``: the best method within a time budget, and the best at twenty times dense's speed.

Both are read off the table, so the best of many methods looks better than it is: confirm the choice on other seeds.
"""

from __future__ import annotations

from collections.abc import Iterator

from torchrl_sparse.evaluation.results.comparisons import num_comparisons, survivors
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry, Results
from torchrl_sparse.evaluation.results.text import (
    count_text,
    milliseconds_text,
    ratio_text,
)

__all__ = ["BUDGETS_MS", "GOAL", "best_within", "budget_rows", "headline", "headline_rows"]

GOAL = 20.0
"""Times dense's speed at which a method is to keep dense's success and its time to success."""

BUDGETS_MS = (1.5, 3.0, 5.0, 10.0, 30.0)
"""Median times of a policy call, of groups whose methods are compared with each other."""


def best_within(results: Results, seconds: float) -> str | None:
    """Return the method with the shortest time to success whose median policy call is within the budget, or None.

    Soonest is the smallest ratio of its restricted mean time, failures counted as the horizon, to dense's on the same seeds.

    >>> best_within(load_results("assets/lift/results.json"), 0.01)  # doctest: +SKIP
    'ddpm3_logsnr'
    """
    ratios = _time_ratios(results)
    known = [name for name in ratios if results.methods[name].latency_s.p50 <= seconds]
    return min(known, key=lambda name: ratios[name], default=None)


def budget_rows(results: Results) -> list[dict[str, str]]:
    """Return one row per time budget, column -> text: the method with the shortest time to success within it."""
    return [_budget_row(results, budget) for budget in BUDGETS_MS]


def _budget_row(results: Results, milliseconds: float) -> dict[str, str]:
    budget, name = {"budget, ms": f"{milliseconds:g}"}, best_within(results, milliseconds / 1e3)
    if name is None:
        return budget | dict.fromkeys(("method", *_cells(results.dense)), "") | {"method": "none"}
    return budget | {"method": name, **_cells(results.methods[name])}


def headline(results: Results, goal: float = GOAL) -> tuple[str | None, str]:
    """Return the method to name first, with its results.

    It is the fastest method that is non-inferior to dense in success and in time. Where it is slower than ``goal``, the second
    text says what the method with the least time to success lacks that is fast enough.

    Args:
        results: of methods whose times to success are known.
        goal: times dense's speed that is asked for.

    Returns:
        Its name, None where no method is non-inferior in both, and a remark.
    """
    methods, ratios = results.methods, _time_ratios(results)
    rivals = [name for name in ratios if name not in _OF_DENSE]
    speed = {name: methods[name].speedup_vs_dense for name in rivals}
    best = max(
        (name for name in rivals if not any(_lacks(methods[name]))),
        key=lambda name: speed[name],
        default=None,
    )
    if best is not None and speed[best] >= goal:
        return best, f"as fast as asked for, {goal:g}×{_after_correction(results, best)}"
    nearest = min(
        (name for name in rivals if speed[name] >= goal), key=lambda name: ratios[name], default=None
    )
    if nearest is None:
        return best, f"no method is {goal:g}× as fast"
    return best, f"{nearest}, {speed[nearest]:.1f}×, is {' and '.join(_lacks(methods[nearest]))}"


def headline_rows(results: Results) -> list[dict[str, str]]:
    """Return `headline` as one row: column -> text."""
    name, remark = headline(results)
    if name is None:
        return [dict.fromkeys(("method", *_cells(results.dense)), "") | {"method": "none", _REMARK: remark}]
    return [{"method": name, **_cells(results.methods[name]), _REMARK: remark}]


_OF_DENSE = (DENSE, "dense_noise")
_REMARK = f"at {GOAL:g} times dense's speed"


def _time_ratios(results: Results) -> dict[str, float]:
    """Return the ratios of the methods whose times are known."""
    return {name: method.time_vs_dense.ratio for name, method in results.methods.items()}


def _after_correction(results: Results, name: str) -> str:
    """Say which verdicts of a method do not survive Holm's correction."""
    lasting = survivors(results)
    lost = [what for what in ("success", "time") if f"{name} {what}" not in lasting]
    if not lost:
        return ""
    return f"; in {' and '.join(lost)} not after Holm's correction for {num_comparisons(results)} comparisons"


def _lacks(method: MethodEntry) -> Iterator[str]:
    """Yield what a method, whose times are known, is not shown to be non-inferior in."""
    for verdict, what in ((method.paired_vs_dense, "success"), (method.time_vs_dense, "time")):
        if verdict.verdict != "non-inferior":
            yield f"{verdict.verdict} in {what}"


def _cells(method: MethodEntry) -> dict[str, str]:
    return {
        "success": count_text(method.success),
        "mean time, steps": f"{method.restricted_mean_time:.1f}",
        "time vs dense": ratio_text(method.time_vs_dense),
        "p50, ms": milliseconds_text(method.latency_s.p50),
        "speed-up": f"{method.speedup_vs_dense:.2f}×",
    }
