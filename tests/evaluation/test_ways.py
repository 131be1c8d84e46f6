"""The ways that episodes took: counted, and as a picture."""

from recipes.studies.pages.ways import way_rows
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.evaluation.figures.ways import count_modes, plot_ways
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult

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
    assert count_modes({"dense": episodes([1, 0]), "other": plain}) == {"dense": [1, 0]}


def test_the_picture_is_drawn_where_no_method_took_a_way(tmp_path):
    path = plot_ways(WAYS | {"uniform": [BETWEEN, NO_WAY]}, tmp_path / "ways.png", title="Lift")
    assert path.stat().st_size > 5000
