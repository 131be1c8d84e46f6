"""A calibrated budget: the choice keeps what it promises, and its file makes the same pruner."""

import json

import pytest

from torchrl_sparse.tokens.budget import BudgetPoint, TokenBudget, smallest_alpha
from torchrl_sparse.tokens.specprune import SpecPrune

POINTS = (
    BudgetPoint(0.2, 40, 0.05),
    BudgetPoint(0.5, 70, 0.01),
    BudgetPoint(0.7, 90, 0.03),
    BudgetPoint(1.0, 99, 0.0),
)


@pytest.mark.parametrize(("tolerance", "alpha"), [(0.0, 1.0), (0.02, 1.0), (0.03, 0.5), (0.05, 0.2)])
def test_no_larger_alpha_may_lose_more_than_the_tolerance(tolerance, alpha):
    """At 0.02, 0.5 would do, but 0.7 would not: that 0.5 does is luck."""
    assert smallest_alpha(POINTS, tolerance) == alpha
    assert smallest_alpha(POINTS[::-1], tolerance) == alpha


def test_a_tolerance_that_none_keeps_is_refused():
    with pytest.raises(ValueError, match=r"at most 0.02 at the largest alpha, got 0.2: 0.05, 0.7: 0.03"):
        smallest_alpha([POINTS[0], POINTS[2]], 0.02)


def test_a_budget_is_read_back_and_makes_its_pruner(tmp_path):
    budget = TokenBudget("release", 0.5, "action_error", 0.03, POINTS, {"keep_share": 0.95})
    budget.save_pretrained(tmp_path / "budget.json")
    again = TokenBudget.from_pretrained(tmp_path / "budget.json")
    assert again == budget
    assert again.pruner().options == SpecPrune("release", alpha=0.5, keep_share=0.95).options


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": "mine"}, "preset: expected 'paper' or 'release', got 'mine'"),
        ({"points": 3}, "points: expected a valid array, got 3"),
        ({"more": 1}, "more: expected no such key, got 1"),
        ({"options": {"keep_shere": 0.5}}, "options: expected fields of SpecPruneOptions, got .*keep_shere"),
        ({"options": {"keep_share": 2}}, "keep_share: expected more than 0 and at most 1, got 2"),
    ],
)
def test_wrong_files_are_named(tmp_path, change, message):
    path = tmp_path / "budget.json"
    TokenBudget("paper", 0.5, "action_error", 0.03, POINTS).save_pretrained(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=message) as error:
        TokenBudget.from_pretrained(path)
    assert str(path) in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        TokenBudget.from_pretrained(tmp_path / "none.json")
