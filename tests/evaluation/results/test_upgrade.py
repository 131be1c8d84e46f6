"""Version 1 and its episodes make version 2; several tasks make an aggregate."""

import json
from dataclasses import replace

import pytest

from recipes.studies.pages.pages import write_tables
from tests.evaluation.synthetic import VERSION_1, make_results, make_runs
from torchrl_sparse.evaluation.results.aggregate import (
    AggregateResults,
    aggregate_results,
    aggregate_rows,
    load_aggregate,
    save_aggregate,
)
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.parts import Difference, PValues, Success, TimeDifference
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.results.upgrade import upgrade_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog
from torchrl_sparse.storage.json import to_plain

NAMES = ("dense", "ddim10", "bac")


def write_logs(folder, runs: dict[str, MethodRun]):
    for name, run in runs.items():
        log = EpisodeLog(folder / "episodes" / f"{name}.jsonl")
        for episode in run.episodes:
            log.append(replace(episode, seed=100_000 + episode.seed))


@pytest.fixture
def old(tmp_path):
    """A file of version 1 with the episodes that it was made from, and what version 2 says of them."""
    results = make_results(100, names=NAMES)
    write_logs(tmp_path, make_runs(100, names=NAMES))
    content = to_plain(results)
    content["schema"] = 1
    for key in ("split", "episode_horizon", "early_cut"):
        del content[key]
    first = {*load_results(VERSION_1).dense.__dataclass_fields__}
    for method in content["methods"].values():
        for key in [*method]:
            if key not in first:
                del method[key]
    path = tmp_path / "results.json"
    path.write_text(json.dumps(content))
    return path, results


def test_an_upgraded_file_says_what_a_new_one_would(old):
    path, expected = old
    upgraded, lacking = upgrade_results(path)
    assert lacking == {}
    without = {name: replace(m, speedup_ci95=None) for name, m in expected.methods.items()}
    assert upgraded == replace(expected, methods=without)
    save_results(upgraded, path)
    assert load_results(path) == upgraded
    with pytest.raises(ValueError, match=r"results.json: schema: expected 1 to upgrade, got 2"):
        upgrade_results(path)


def test_methods_without_their_episodes_are_named_and_keep_what_they_had(old):
    path, expected = old
    (path.parent / "episodes" / "bac.jsonl").unlink()
    log = path.parent / "episodes" / "ddim10.jsonl"
    log.write_text("\n".join(log.read_text().splitlines()[:-1]) + "\n")
    upgraded, lacking = upgrade_results(path)
    assert lacking["bac"].startswith("got no")
    assert "solved of 100" in lacking["ddim10"]
    assert lacking["ddim10"].endswith("of 99")
    for name in ("bac", "ddim10"):
        entry = upgraded.methods[name]
        assert entry.success == expected.methods[name].success
        assert entry.latency_s == expected.methods[name].latency_s
        assert entry.time_vs_dense is entry.success_within is entry.p_values is None
    assert upgraded.dense.time_vs_dense.ratio == 1


def test_without_dense_nothing_is_upgraded(old):
    path, _ = old
    (path.parent / "episodes" / "dense.jsonl").unlink()
    with pytest.raises(ValueError, match="expected the episodes of 'dense', got no"):
        upgrade_results(path)


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
    save_aggregate(results, tmp_path / "aggregate.json")
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
    with pytest.raises(
        ValueError, match=r"expected the 100 episodes from seed .* that results.json counts, got 99"
    ):
        aggregate_results(tasks)
    log.write_text(kept)
    dense = results.dense
    wider = replace(dense, paired_vs_dense=replace(dense.paired_vs_dense, margin=0.1))
    save_results(replace(results, methods=results.methods | {"dense": wider}), path)
    with pytest.raises(ValueError, match="aggregate: expected the same margins in all files"):
        aggregate_results(tasks)
    nothing = replace(dense, success=Success.of([False] * 100))
    save_results(replace(results, methods=results.methods | {"dense": nothing}), path)
    with pytest.raises(ValueError, match="Dense solved none"):
        aggregate_results(tasks)


def test_what_cannot_be_put_together_is_named(tasks):
    with pytest.raises(ValueError, match="aggregate: expected different tasks of one split"):
        aggregate_results([tasks[0], tasks[0].parent / ".." / "Lift" / "results.json"])
    with pytest.raises(ValueError, match=r"version_1.json: schema: expected 2 to aggregate, got 1"):
        aggregate_results([VERSION_1])
    with pytest.raises(FileNotFoundError, match=r"expected a file nothing.json"):
        aggregate_results(["nothing.json"])
