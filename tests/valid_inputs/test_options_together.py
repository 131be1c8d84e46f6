"""Options that are valid each: two that exclude each other are refused, and none is passed over without a word."""

import tests.options.test_benchmark as benchmark
import tests.options.test_evaluate_policy as evaluate_policy
import tests.options.test_report as report
import tests.options.test_studies as studies
from tests.options.harness import play
from tests.refusals import refused


def test_a_report_is_asked_for_one_thing(tmp_path):
    """Own: the recipe's page says "or"; all but the first were passed over."""
    with refused("budgets"):
        play(report.TestOptions, tmp_path, ["aggregate=[can.json]", "budgets=[budget.json]"])


def test_a_sampler_beside_a_pruner_is_refused(tmp_path):
    """Own: a pruner serves the chain that it was trained for; the sampler was passed over."""
    with refused("sampler"):
        play(studies.TestLooking, tmp_path, ["sampler=ddim3"])


def test_a_film_of_what_is_not_measured_is_not_made_and_that_is_said(tmp_path):
    """Own: a name among `videos` that is a method but not among `methods` was passed over."""
    run = play(benchmark.TestOptions, tmp_path, ["videos=[uniform,saved]", "methods=[uniform]"])
    assert "no video of saved: not among the methods" in run.printed
    assert [call["name"] for call in run.calls[benchmark.FILMED]] == ["uniform"]


def test_one_episode_has_no_standard_error(tmp_path):
    """Own: a deviation needs two; it was printed as nan."""
    run = play(evaluate_policy.TestOptions, tmp_path, ["episodes=1"])
    assert "score " in run.printed
    assert "nan" not in run.printed
