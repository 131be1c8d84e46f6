"""Points pair with the right dense episodes, and what is written is what is drawn."""

import pytest
from PIL import Image

from tests.evaluation.synthetic import MACHINE
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.results.realtime import (
    RealtimeRun,
    build_realtime,
    format_realtime,
    load_realtime,
    save_realtime,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.storage.json import to_plain, write_json


def episodes(successes, n=20, first=0):
    return [EpisodeResult(first + i, i < successes, 30, 4, 1e9, 0.0) for i in range(n)]


def build(**runs):
    options = {"task": "LiftMoving", "seed": 0, "control_freq": 20.0, "n_action_steps": 8, "margin": 0.05}
    return build_realtime(runs, machine=MACHINE, **options)


DENSE = RealtimeRun(0.145, {0: episodes(20), 1: episodes(18), 3: episodes(10)})
FAST = RealtimeRun(0.024, {0: episodes(19), 1: episodes(17), 3: episodes(8)})


def test_own_points_pair_with_the_dense_policy_at_its_own_latency():
    points = {name: method.points for name, method in build(dense=DENSE, bac=FAST).methods.items()}
    assert [(p.delay_steps, p.own) for p in points["dense"]] == [(0, False), (1, False), (3, True)]
    assert [(p.delay_steps, p.own) for p in points["bac"]] == [(0, False), (1, True), (3, False)]
    diffs = [p.paired_vs_dense.diff for p in points["bac"]]
    assert diffs == pytest.approx([-1 / 20, 17 / 20 - 10 / 20, -2 / 20])
    assert [p.success.k for p in points["dense"]] == [20, 18, 10]


def test_what_cannot_be_paired_is_refused():
    with pytest.raises(ValueError, match="expected the method 'dense' among them"):
        build(bac=FAST)
    lonely = RealtimeRun(0.024, {1: episodes(3), 7: episodes(3)})
    with pytest.raises(ValueError, match="bac: expected episodes of 'dense' at 7 steps of delay too"):
        build(dense=DENSE, bac=lonely)
    other = RealtimeRun(0.024, {1: episodes(3, first=5)})
    with pytest.raises(ValueError, match="bac: expected the seeds of 'dense'"):
        build(dense=DENSE, bac=other)


def test_file_table_and_figure(tmp_path):
    results = build(dense=DENSE, bac=FAST)
    assert load_realtime(save_realtime(results, tmp_path / "realtime.json")) == results
    table = format_realtime(results)
    assert "145 ms, its own" in table
    assert "+35.0" in table
    with Image.open(plot_realtime(results, tmp_path / "realtime.png")) as image:
        assert image.size[0] == 900
    (tmp_path / "realtime.json").write_text('{"schema": 1}')
    with pytest.raises(ValueError, match=r"realtime.json: realtime: expected this key"):
        load_realtime(tmp_path / "realtime.json")
    content = to_plain(results)
    del content["methods"]["bac"]["points"][1]["success"]["k"]
    write_json(tmp_path / "realtime.json", content)
    with pytest.raises(ValueError, match=r"realtime.json: methods.bac.points.1.success.k: expected this key"):
        load_realtime(tmp_path / "realtime.json")
