"""Episodes come back from what they are written as, and folders are whole or not there."""

import json
import sys

import pytest

from tests.evaluation.compare.test_files import VLA_EVAL, write
from tests.refusals import refused
from torchrl_sparse.evaluation.compare.export import lerobot_info, write_episodes, write_lerobot
from torchrl_sparse.evaluation.compare.files import read_methods
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes, Outcome, Start


def methods():
    seeds = [Start("Lift", "seed", seed) for seed in (7, 8)]
    more = {"queries": 4, "flops": 6.5e10}
    a = MethodOutcomes(
        "a", "a", [Outcome(seeds[0], True, 31, more=more), Outcome(seeds[1], False, 400, more=more)]
    )
    b = MethodOutcomes(
        "b:int8", "b", [Outcome(seeds[0], True, 35, 0.5), Outcome(seeds[1], False, 400, error="lost")]
    )
    return [a, b]


def told(found):
    return [[(o.start, o.success, o.steps) for o in method.outcomes] for method in found]


def test_a_table_comes_back(tmp_path):
    path = write_episodes(methods(), tmp_path / "episodes.csv")
    back = read_methods([path], "failure")
    assert [method.name for method in back] == ["a", "b:int8"]
    assert told(back) == told(methods())
    head, first, *_ = path.read_text().splitlines()
    assert head == "task,method,seed,success,steps,score,error,queries,flops"
    assert first == "Lift,a,7,true,31,,,4,65000000000.0"


def test_lerobots_layout_comes_back_with_its_seeds(tmp_path):
    folder = write_lerobot(methods(), tmp_path / "out")
    back = read_methods([folder / "a", folder / "b:int8"])
    assert told(back) == told(methods())
    data = json.loads((folder / "a" / "eval_info.json").read_text())
    assert set(data) == {"per_task", "per_group", "overall", "per_episode"}
    assert data["per_task"][0]["metrics"]["successes"] == [True, False]
    assert (data["overall"]["pc_success"], data["overall"]["n_episodes"]) == (50.0, 2)
    assert data["per_group"]["Lift"]["avg_sum_reward"] == 0.5


def test_rewards_that_nobody_noted_are_null():
    metrics = lerobot_info(methods()[1])["per_task"][0]["metrics"]
    assert (metrics["sum_rewards"], metrics["max_rewards"]) == ([None, 0.0], [0.5, 0.0])


def test_a_folder_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    with refused("lerobot"):
        write_lerobot(methods(), tmp_path / "there")
    calls = []

    def fail_late(method):
        calls.append(method)
        if len(calls) > 1:
            raise OSError("full")
        return {}

    monkeypatch.setattr("torchrl_sparse.evaluation.compare.export.lerobot_info", fail_late)
    with pytest.raises(OSError, match="full"):
        write_lerobot(methods(), tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_other_kinds_of_table_are_refused(tmp_path, monkeypatch):
    with refused("table_file"):
        write_episodes(methods(), tmp_path / "episodes.txt")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with refused("pyarrow", ImportError):
        write_episodes(methods(), tmp_path / "episodes.parquet")
    assert not list(tmp_path.iterdir())


def test_parquet_where_pyarrow_is(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(write_episodes(methods(), tmp_path / "episodes.parquet"))
    assert table.column("steps").to_pylist() == [31, 400, 35, 400]


def test_other_harnesses_episodes_are_converted(tmp_path):
    found = read_methods([write(tmp_path / "pusht.json", VLA_EVAL)], "exclude")
    assert "pusht/push,pusht,0,true,30" in write_episodes(found, tmp_path / "t.csv").read_text()
