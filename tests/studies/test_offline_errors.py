"""Whether errors of answers say how episodes go."""

from dataclasses import replace

import pytest

from recipes.studies.offline_errors.agreement import (
    agreement_of,
    load_agreement,
    save_agreement,
    together_rows,
)
from recipes.studies.offline_errors.agreement_figure import plot_agreement
from recipes.studies.offline_errors.errors import OfflineErrors
from recipes.studies.offline_errors.figure import plot_offline
from recipes.studies.offline_errors.results import (
    OfflineResults,
    Outcome,
    agreement_rows,
    error_rows,
    load_offline,
    outcomes,
    rank_agreement,
    save_offline,
)
from recipes.studies.pages.page_rows import read_table
from tests.refusals import refused
from torchrl_sparse.evaluation.results.schema import load_results


@pytest.fixture
def results():
    """Smaller errors come with shorter times; the energy score is the other way round."""
    errors = {f"ddim{n}": OfflineErrors(n / 10, -float(n), 0.5 - n / 8, 0.1 * (n % 3)) for n in (2, 3, 4, 5)}
    played = {name: Outcome(-entry.error, 1 + entry.error) for name, entry in errors.items()}
    errors = {"dense": OfflineErrors(0.1, 0.1, 0.0, 0.2), **errors}
    return OfflineResults(1, "Lift", "abc", 4, 8, 0, errors, {"a.json": played})


def test_orders_that_agree_correlate(results):
    assert rank_agreement(results, "a.json", "error") == pytest.approx(Outcome(1.0, 1.0))
    assert rank_agreement(results, "a.json", "energy_score") == pytest.approx(Outcome(-1.0, -1.0))
    rows = {row["measure"]: row for row in agreement_rows(results)}
    assert rows["error"] == {
        "measure": "error",
        "a.json, 4 methods: success": "+1.00",
        "a.json: time": "+1.00",
    }
    assert error_rows(results)[0] == {
        "method": "dense",
        "error": "0.100",
        "energy score": "0.100",
        "energy distance": "0.000",
        "spread": "0.200",
    }


def test_outcomes_are_those_of_the_table():
    found = outcomes(load_results("assets/can/weaker/results_300.json"))
    assert {"dense", "dense_noise"}.isdisjoint(found)
    assert found["sag"].success == pytest.approx((255 - 273) / 300)
    assert found["sag"].time == pytest.approx(
        load_results("assets/can/weaker/results_300.json").methods["sag"].time_vs_dense.ratio
    )


def test_tables_are_put_together_by_their_ranks(results, tmp_path):
    """Of two tables alike the mean is that of each; chance orders the methods of both so in 2 of 4! ** 2 cases."""
    other = replace(results, task="Can", played={"assets/can/results.json": results.played["a.json"]})
    agreement = agreement_of([results, other])
    error = agreement.success["error"]
    assert error.tables == pytest.approx({"a": 1.0, "can": 1.0})
    assert error.together == pytest.approx(1.0)
    assert error.p == pytest.approx(2 / 24**2, abs=2e-3)
    assert agreement.time["energy_score"].together == pytest.approx(-1.0)
    assert load_agreement(save_agreement(agreement, tmp_path / "offline_agreement.json")) == agreement
    assert plot_agreement(agreement, tmp_path / "a.png").stat().st_size > 10_000
    assert together_rows(agreement)["success"][0] == {
        "measure": "error",
        "a, 4": "+1.00",
        "can, 4": "+1.00",
        "together, 8": "+1.00",
        "p": f"{error.p:.4f}",
        "over the error": "",
    }
    table = read_table(tmp_path / "offline_agreement.json", "time")
    assert table.task == "a, can"
    assert [table.name(row) for row in table.rows] == ["error", "energy score", "energy distance", "spread"]
    with refused("aggregate"):
        agreement_of([results, results])


def test_they_are_kept_and_drawn(results, tmp_path):
    path = save_offline(results, tmp_path / "offline_errors_Lift.json")
    assert load_offline(path) == results
    assert plot_offline(results, "a.json", tmp_path / "a.png").stat().st_size > 10_000


def test_a_graded_task_comes_to_its_scores():
    results = load_results("assets/pusht/shorter/results.json")
    found, entry = outcomes(results)["ddpm2_logsnr"], results.methods["ddpm2_logsnr"]
    assert found.success == entry.score.mean - results.dense.score.mean < -0.3
    assert abs(entry.success.rate - results.dense.success.rate) < 0.02
