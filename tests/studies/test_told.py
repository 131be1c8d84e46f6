"""What only episodes tell, ways and parts of a task: a page reads it from the logs beside its results."""

import pytest

from recipes.studies.pages.completed import completed_rows
from recipes.studies.pages.page_rows import read_table
from recipes.studies.pages.ways import way_rows
from tests.evaluation.synthetic import make_results
from tests.refusals import refused
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult


@pytest.mark.parametrize(
    ("which", "field", "told", "rows"),
    [
        ("ways", "way", {"dense": [0, 1, 0, 1], "ddim10": [0, 0, BETWEEN, NO_WAY]}, way_rows),
        ("completed", "completed", {"dense": [2, 2, 1, 2], "ddim10": [0, 1, 0, 0]}, completed_rows),
    ],
)
def test_a_page_reads_it_from_the_episodes_beside_its_results(which, field, told, rows, tmp_path):
    save_results(make_results(4, names=("dense", "ddim10")), tmp_path / "results.json")
    for name, values in told.items():
        log = EpisodeLog(tmp_path / "episodes" / f"{name}.jsonl")
        for index, value in enumerate([*values, 1]):  # the last is not of these results
            log.append(EpisodeResult(100_000 + index, True, 30, 4, 1e9, 0.0, **{field: value}))
    assert read_table(tmp_path / "results.json", which).rows == rows(told)


@pytest.mark.parametrize(
    ("which", "expected"), [("ways", "that tell their ways"), ("completed", "that count its parts")]
)
def test_a_page_that_asks_a_task_that_does_not_tell_it_is_told(which, expected, tmp_path):
    save_results(make_results(4, names=("dense",)), tmp_path / "results.json")
    EpisodeLog(tmp_path / "episodes" / "dense.jsonl").append(EpisodeResult(100_000, True, 30, 4, 1e9, 0.0))
    with refused("rows"):
        read_table(tmp_path / "results.json", which)
