"""The parts of a task that episodes did: the published levels, counted from their logs as a table of a page."""

import pytest

from tests.evaluation.synthetic import make_results
from torchrl_sparse.evaluation.results.completed import completed_rows, told_completed
from torchrl_sparse.evaluation.results.page_rows import read_table
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult

PARTS = {"dense": [2, 2, 1, 2], "ddim10": [0, 1, 0, 0]}


def episodes(parts):
    return [
        EpisodeResult(100_000 + i, done == 2, 30, 4, 1e9, 0.0, completed=done) for i, done in enumerate(parts)
    ]


def test_an_episode_counts_at_every_level_that_it_reached():
    dense, ddim = completed_rows(PARTS)
    assert [dense[level].split()[0] for level in ("p1", "p2")] == ["4/4", "3/4"]
    assert [ddim[level].split()[0] for level in ("p1", "p2")] == ["1/4", "0/4"]
    assert completed_rows({"uniform": [0, 0]}) == [{"method": "uniform", "p1": "0/2 [0, 66] %"}]


def test_a_task_of_one_part_counts_none():
    plain = [EpisodeResult(0, True, 30, 4, 1e9, 0.0)]
    assert told_completed({"dense": episodes([1, 0]), "other": plain}) == {"dense": [1, 0]}


def test_a_page_reads_them_from_the_episodes_beside_its_results(tmp_path):
    save_results(make_results(4, names=("dense", "ddim10")), tmp_path / "results.json")
    for name, parts in PARTS.items():
        log = EpisodeLog(tmp_path / "episodes" / f"{name}.jsonl")
        for episode in episodes([*parts, 2]):  # the last is not of these results
            log.append(episode)
    assert read_table(tmp_path / "results.json", "completed").rows == completed_rows(PARTS)


def test_a_page_that_asks_for_parts_of_a_task_without_is_told(tmp_path):
    save_results(make_results(4, names=("dense",)), tmp_path / "results.json")
    EpisodeLog(tmp_path / "episodes" / "dense.jsonl").append(EpisodeResult(100_000, True, 30, 4, 1e9, 0.0))
    with pytest.raises(ValueError, match="rows: expected episodes of lift that count its parts, got none"):
        read_table(tmp_path / "results.json", "completed")
