"""The ways that episodes took: counted from their logs, as a table of a page and a picture."""

import pytest

from tests.evaluation.synthetic import make_results
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.evaluation.figures.ways import plot_ways
from torchrl_sparse.evaluation.results.page_rows import read_table
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.ways import told_ways, way_rows
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult

WAYS = {"dense": [0, 1, 0, 1], "ddim10": [0, 0, BETWEEN, NO_WAY]}


def episodes(ways):
    return [
        EpisodeResult(100_000 + index, way >= 0, 30, 4, 1e9, 0.0, way=way) for index, way in enumerate(ways)
    ]


def test_every_episode_is_counted_once():
    dense, ddim = way_rows(WAYS)
    assert [dense[name] for name in ("episodes", "way 0", "way 1", "none", "entropy, bits")] == [
        "4",
        "2",
        "2",
        "0",
        "1.00",
    ]
    assert [ddim[name] for name in ("way 0", "way 1", "between", "none")] == ["2", "0", "1 [5, 70] %", "1"]
    assert ddim["entropy, bits"] == "0.00"
    (lost,) = way_rows({"uniform": [BETWEEN, NO_WAY]})
    assert lost["entropy, bits"] == ""  # of no way there is none


def test_tasks_of_one_way_tell_none():
    plain = [EpisodeResult(0, True, 30, 4, 1e9, 0.0)]
    assert told_ways({"dense": episodes([1, 0]), "other": plain}) == {"dense": [1, 0]}


def test_a_page_reads_them_from_the_episodes_beside_its_results(tmp_path):
    save_results(make_results(4, names=("dense", "ddim10")), tmp_path / "results.json")
    for name, ways in WAYS.items():
        log = EpisodeLog(tmp_path / "episodes" / f"{name}.jsonl")
        for episode in episodes([*ways, 1]):  # the last is not of these results
            log.append(episode)
    assert read_table(tmp_path / "results.json", "ways").rows == way_rows(WAYS)


def test_a_page_that_asks_for_ways_of_a_task_without_is_told(tmp_path):
    save_results(make_results(4, names=("dense",)), tmp_path / "results.json")
    EpisodeLog(tmp_path / "episodes" / "dense.jsonl").append(EpisodeResult(100_000, True, 30, 4, 1e9, 0.0))
    with pytest.raises(ValueError, match="rows: expected episodes of lift that tell their ways, got none"):
        read_table(tmp_path / "results.json", "ways")


def test_the_picture_is_drawn_where_no_method_took_a_way(tmp_path):
    path = plot_ways(WAYS | {"uniform": [BETWEEN, NO_WAY]}, tmp_path / "ways.png", title="Lift")
    assert path.stat().st_size > 5000
