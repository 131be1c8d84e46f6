"""Holm's correction, against its definition."""

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.multiplicity import holm


def test_it_steps_down_until_one_fails():
    p_values = {"a": 0.004, "b": 0.006, "c": 0.02, "d": 0.0249}
    assert holm(p_values) == {"a", "b"}
    assert holm({"a": 0.02, "b": 0.001}) == {"a", "b"}
    assert holm({"a": 0.02, "b": 0.013}) == set()


def test_comparisons_without_a_p_value_count():
    assert holm({"a": 0.004}, comparisons=7) == set()
    assert holm({"a": 0.003}, comparisons=7) == {"a"}
    with refused("comparisons"):
        holm({"a": 0.1, "b": 0.1}, comparisons=1)
