"""The parts of a task that episodes did: the published levels."""

from recipes.studies.pages.completed import completed_rows, told_completed
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult

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
