"""A calibrated budget: the choice keeps what it promises, and its file makes the same pruner."""

import json

import pytest

from tests.refusals import refused
from torchrl_sparse.methods.token_budget import BudgetPoint, TokenBudget, fewest_tokens, numbered_pruner
from torchrl_sparse.methods.vla import TOKEN_METHODS
from torchrl_sparse.tokens.specprune import SpecPrune

POINTS = (
    BudgetPoint(0.2, 40, 0.05),
    BudgetPoint(0.5, 70, 0.01),
    BudgetPoint(0.7, 90, 0.03),
    BudgetPoint(1.0, 99, 0.0),
)


@pytest.mark.parametrize(("tolerance", "number"), [(0.0, 1.0), (0.02, 1.0), (0.03, 0.5), (0.05, 0.2)])
def test_nothing_that_keeps_more_may_lose_more_than_the_tolerance(tolerance, number):
    """At 0.02, 0.5 would do, but 0.7 would not: that 0.5 does is luck."""
    assert fewest_tokens(POINTS, tolerance) == number
    assert fewest_tokens(POINTS[::-1], tolerance) == number


def test_where_all_keep_as_many_the_number_decides():
    """VLA-Cache's share of reused tokens drops none, and the more it reuses the more it loses."""
    points = [BudgetPoint(0.5, 72, 0.04), BudgetPoint(0.1, 72, 0.0), BudgetPoint(0.3, 72, 0.01)]
    assert fewest_tokens(points, 0.02) == 0.3


def test_every_method_with_a_number_is_made_at_that_number():
    for name, method in TOKEN_METHODS.items():
        if method.number is not None:
            pruner = numbered_pruner(name, 0.5, {})
            described = pruner.options if hasattr(pruner, "options") else getattr(pruner, "inner", pruner)
            assert getattr(described, method.number) == 0.5, name


def test_a_tolerance_that_none_keeps_is_refused():
    with refused("tolerance"):
        fewest_tokens([POINTS[0], POINTS[2]], 0.02)


def test_a_budget_is_read_back_and_makes_its_pruner(tmp_path):
    settings = {"preset": "release", "keep_share": 0.95}
    budget = TokenBudget("specprune", 0.5, "action_error", 0.03, POINTS, settings)
    budget.save_pretrained(tmp_path / "budget.json")
    again = TokenBudget.from_pretrained(tmp_path / "budget.json")
    assert again == budget
    assert again.pruner().options == SpecPrune("release", alpha=0.5, keep_share=0.95).options


@pytest.mark.parametrize(
    ("change", "entry"),
    [
        ({"method": "mine"}, "budget.json: method"),
        ({"method": "dense"}, "budget.json: method"),
        (
            {"method": "fastv", "settings": {"keep_share": 1}},
            "budget.json: settings",
        ),
        ({"settings": {"preset": "mine"}}, "budget.json: preset"),
        ({"points": 3}, "budget.json: points"),
        ({"more": 1}, "budget.json: more"),
        ({"settings": {"keep_shere": 0.5}}, "budget.json: settings"),
        ({"settings": {"keep_share": 2}}, "budget.json: keep_share"),
    ],
)
def test_wrong_files_are_named(tmp_path, change, entry):
    path = tmp_path / "budget.json"
    TokenBudget("specprune", 0.5, "action_error", 0.03, POINTS).save_pretrained(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with refused(entry) as error:
        TokenBudget.from_pretrained(path)
    assert str(path) in str(error.value)
    with refused("none.json", FileNotFoundError):
        TokenBudget.from_pretrained(tmp_path / "none.json")
