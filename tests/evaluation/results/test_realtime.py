"""Points pair with the right dense episodes, and what is written is what is drawn."""

import pytest
from PIL import Image

from recipes.studies.pages.delayed_pairs import late_pair_rows
from tests.evaluation.synthetic import MACHINE
from tests.refusals import refused
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.results.build import Terms
from torchrl_sparse.evaluation.results.realtime import (
    RealtimeRun,
    build_realtime,
    format_realtime,
    load_realtime,
    num_late_comparisons,
    realtime_rows,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.statistics.sequential import Design
from torchrl_sparse.storage.json import to_plain, write_json


def episodes(successes, n=20, first=0):
    return [
        EpisodeResult(first + i, i < successes, 30 if i < successes else 50, 4, 1e9, 0.0) for i in range(n)
    ]


def build(**runs):
    options = {"task": "LiftMoving", "split": "test", "seed": 0, "control_freq": 20.0, "n_action_steps": 8}
    return build_realtime(runs, machine=MACHINE, terms=Terms(Design(20), 50), **options)


DENSE = RealtimeRun(0.145, {0: episodes(20), 1: episodes(18), 3: episodes(10)})
FAST = RealtimeRun(0.024, {0: episodes(19), 1: episodes(17), 3: episodes(8)})


def test_own_points_pair_with_the_dense_policy_at_its_own_latency():
    points = {name: method.points for name, method in build(dense=DENSE, bac=FAST).methods.items()}
    assert [(p.delay_steps, p.own) for p in points["dense"]] == [(0, False), (1, False), (3, True)]
    assert [(p.delay_steps, p.own) for p in points["bac"]] == [(0, False), (1, True), (3, False)]
    diffs = [p.paired_vs_dense.diff for p in points["bac"]]
    assert diffs == pytest.approx([-1 / 20, 17 / 20 - 10 / 20, -2 / 20])
    assert [p.success.k for p in points["dense"]] == [20, 18, 10]


def test_times_pair_like_successes():
    results = build(dense=DENSE, bac=FAST)
    dense, bac = (results.methods[name].points for name in ("dense", "bac"))
    means = [point.restricted_mean_time for point in dense]
    assert means == pytest.approx([30, 30 * 0.9 + 50 * 0.1, 40])
    own = bac[1]
    assert own.restricted_mean_time == pytest.approx(30 * 0.85 + 50 * 0.15)
    assert own.time_vs_dense.ratio == pytest.approx(33 / 40)  # to dense three steps late
    assert own.time_vs_dense.verdict == own.paired_vs_dense.verdict == "non-inferior"
    assert [point.time_vs_dense.ratio for point in dense] == [1, 1, 1]
    assert all(point.p_values is None for point in dense)
    assert all(0 <= point.p_values.time <= 0.5 for point in bac)


def test_verdicts_count_and_those_of_chance_are_marked():
    results = build(dense=DENSE, bac=FAST)
    assert num_late_comparisons(results) == 6
    row = realtime_rows(results)[4]
    assert (row["method"], row["delay, steps"], row["mean time, steps"]) == ("bac", "1", "33.0")
    assert (row["verdict"], row["time verdict"]) == ("non-inferior", "non-inferior")
    many = build(dense=DENSE, bac=FAST, **{f"m{i}": FAST for i in range(40)})
    assert all(row["verdict"] != "non-inferior" for row in realtime_rows(many))


def test_late_points_are_compared_from_their_logs_wherever_those_lie(tmp_path):
    path = write_json(tmp_path / "realtime.json", build(dense=DENSE, bac=FAST))
    for log, played in {
        tmp_path / "episodes" / "bac_delay1.jsonl": episodes(17, n=21, first=210_000),  # one of no point
        tmp_path / "dense_delay3.jsonl": episodes(10, first=210_000),
    }.items():
        for episode in played:
            EpisodeLog(log).append(episode)
    (row,) = late_pair_rows(path, [("bac +1", "dense +3")])
    own = realtime_rows(load_realtime(path))[4]
    assert row["success"] == "17 : 10"
    assert (row["difference, points"], row["time ratio"]) == (own["vs dense, points"], own["time vs dense"])
    with refused("pairs"):
        late_pair_rows(path, [("bac +0", "dense +3")])
    with refused("jsonl", FileNotFoundError):
        late_pair_rows(path, [("bac +3", "dense +3")])


def test_what_cannot_be_paired_is_refused():
    with refused("runs"):
        build(bac=FAST)
    lonely = RealtimeRun(0.024, {1: episodes(3), 7: episodes(3)})
    with refused("bac"):
        build(dense=DENSE, bac=lonely)
    other = RealtimeRun(0.024, {1: episodes(3, first=5)})
    with refused("bac"):
        build(dense=DENSE, bac=other)


def test_file_table_and_figure(tmp_path):
    results = build(dense=DENSE, bac=FAST)
    assert load_realtime(write_json(tmp_path / "realtime.json", results)) == results
    table = format_realtime(results)
    assert "145 ms, its own" in table
    assert "+35.0" in table
    with Image.open(plot_realtime(results, tmp_path / "realtime.png")) as image:
        assert image.size[0] == 900
    write_json(tmp_path / "realtime.json", to_plain(results) | {"realtime": 1})
    with refused("realtime.json: realtime"):
        load_realtime(tmp_path / "realtime.json")
    content = to_plain(results)
    del content["methods"]["bac"]["points"][1]["success"]["k"]
    write_json(tmp_path / "realtime.json", content)
    with refused("realtime.json: methods.bac.points.1.success.k"):
        load_realtime(tmp_path / "realtime.json")
