"""Several tasks make an aggregate."""

from dataclasses import replace

import pytest

from recipes.studies.pages.pages import write_tables
from tests.evaluation.synthetic import make_results, make_runs
from tests.refusals import refused
from torchrl_sparse.evaluation.results.aggregate import (
    AggregateResults,
    aggregate_results,
    aggregate_rows,
    load_aggregate,
)
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.parts import PValues, Success
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference
from torchrl_sparse.storage.json import write_json

NAMES = ("dense", "ddim10", "bac")


def write_logs(folder, runs: dict[str, MethodRun]):
    for name, run in runs.items():
        log = EpisodeLog(folder / "episodes" / f"{name}.jsonl")
        for episode in run.episodes:
            log.append(replace(episode, seed=100_000 + episode.seed))


@pytest.fixture
def tasks(tmp_path):
    paths = []
    for index, task in enumerate(("Lift", "PickPlaceCan")):
        runs = make_runs(60 + 40 * index, names=NAMES if index else ("dense", "bac"), seed=index)
        results = make_results(60 + 40 * index, names=tuple(runs), seed=index)
        path = tmp_path / task / "results.json"
        save_results(replace(results, task=task), path)
        write_logs(path.parent, runs)
        paths.append(path)
    return paths


def test_tasks_are_put_together_for_the_methods_that_all_have(tasks, tmp_path):
    results = aggregate_results(tasks)
    assert list(results.methods) == ["bac"]
    entry = results.methods["bac"]
    each = [load_results(path).methods["bac"] for path in tasks]
    assert entry.paired_vs_dense.diff == pytest.approx(sum(m.paired_vs_dense.diff for m in each) / 2)
    ratios = [m.time_vs_dense.ratio for m in each]
    assert entry.time_vs_dense.ratio == pytest.approx((ratios[0] * ratios[1]) ** 0.5)
    assert entry.episodes == 160
    write_json(tmp_path / "aggregate.json", results)
    assert load_aggregate(tmp_path / "aggregate.json") == results
    page = write_tables("<!-- table: aggregate.json -->\n<!-- end -->", tmp_path)
    assert aggregate_rows(results)[0]["time vs dense"] in page


def test_verdicts_over_tasks_that_do_not_survive_a_correction_for_all_are_marked(tasks):
    entry = aggregate_results(tasks).methods["bac"]

    def judged(half, p):
        """Two points below dense, give or take half an interval, at twice its time."""
        success = Difference(-0.02, (-0.02 - half, -0.02 + half), 0.05, "non-inferior")
        time = TimeDifference(2.0, (1.8, 2.2), 0.1, "inferior")
        return replace(entry, paired_vs_dense=success, time_vs_dense=time, p_values=PValues(p, 1e-6))

    barely, clearly = judged(0.0299, 0.0246), judged(0.01, 1e-6)
    results = AggregateResults(2, ("Lift", "Can"), "test", {"barely": barely, "clearly": clearly})
    rows = {row["method"]: row for row in aggregate_rows(results)}
    # p = .0246 the last of four may have, but none of three that are left.
    assert rows["barely"]["verdict"] == "non-inferior"
    assert rows["clearly"]["verdict"] == "non-inferior, worse"
    several = {f"barely {index}": barely for index in range(2)}
    rows = aggregate_rows(replace(results, methods=results.methods | several))
    marked = {row["method"] for row in rows if row["verdict"].endswith("†")}
    assert marked == {"barely", *several}
    assert {row["time verdict"] for row in rows} == {"inferior"}


def test_what_says_nothing_over_tasks_is_named(tasks):
    """Margins that differ, a log that lacks episodes, and a task in which dense solved none; pairs are never dropped."""
    path, results = tasks[1], load_results(tasks[1])
    log = path.parent / "episodes" / "bac.jsonl"
    kept = log.read_text()
    log.write_text("".join(kept.splitlines(keepends=True)[:-1]))
    with refused("bac.jsonl"):
        aggregate_results(tasks)
    log.write_text(kept)
    dense = results.dense
    wider = replace(dense, paired_vs_dense=replace(dense.paired_vs_dense, margin=0.1))
    save_results(replace(results, methods=results.methods | {"dense": wider}), path)
    with refused("aggregate"):
        aggregate_results(tasks)
    nothing = replace(dense, success=Success.of([False] * 100))
    save_results(replace(results, methods=results.methods | {"dense": nothing}), path)
    with refused("results.json"):
        aggregate_results(tasks)


def test_what_cannot_be_put_together_is_named(tasks):
    with refused("aggregate"):
        aggregate_results([tasks[0], tasks[0].parent / ".." / "Lift" / "results.json"])
    with refused("nothing.json", FileNotFoundError):
        aggregate_results(["nothing.json"])
