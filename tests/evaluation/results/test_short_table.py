"""The table on a terminal, and which method it advises."""

import pytest

from tests.evaluation.results.test_report import build, run
from torchrl_sparse.evaluation.results.short_table import advice, short_table


def methods(n, *, fast=1.0, solved=1.0, noise=False):
    """Dense, and a method of this latency that solves this share of what dense solves."""
    kept = round(solved * n)
    other = "dense_noise" if noise else "fast"
    return build({"dense": run([1] * n), other: run([1] * kept + [0] * (n - kept), latency=fast)})


@pytest.mark.parametrize(
    ("results", "said"),
    [
        (methods(400, fast=0.1), "Use fast: 10.0 times dense's speed, and not worse by 5 points."),
        (methods(400, fast=0.1, solved=0.8), "Use dense: no faster method is shown to be as good."),
        (methods(400, fast=2.0), "Use dense"),
        (methods(400, fast=0.1, noise=True), "Use dense"),
        (methods(10, fast=0.1), "So far fast: 10.0 times dense's speed, solved 10 of 10. 10 episodes can show no more: 73"),
    ],
)  # fmt: skip
def test_the_advice_is_what_is_shown(results, said):
    assert advice(results).startswith(said)


def test_the_fastest_of_many_has_to_survive_their_correction():
    one = {"dense": run([1] * 80), "fast": run([1] * 80, latency=0.1)}
    many = one | {f"other{i}": run([1] * 80, latency=0.2) for i in range(8)}
    assert advice(build(one)).startswith("Use fast")
    assert advice(build(many)).startswith("Use dense: no faster method is shown")


def test_a_dense_policy_that_solves_nothing_is_said():
    none = build({"dense": run([0] * 80), "fast": run([0] * 80, latency=0.1)})
    assert advice(none).startswith("Dense solved none")
    assert "non-inferior" not in short_table(none)


def test_the_table_has_six_columns_and_two_lines_of_notes():
    table, notes, told = short_table(methods(10, fast=0.1)).split("\n\n")
    assert table.splitlines()[0].count("|") == 7
    assert "1.00 [" in table.splitlines()[-1]
    assert len(notes.splitlines()) == 2
    assert "table=full" in notes
    assert told.startswith("So far fast")
