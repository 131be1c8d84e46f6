"""What is tuned on never meets what is tested on."""

from itertools import pairwise

from tests.refusals import refused
from torchrl_sparse.envs.seeds import (
    CALIBRATION_SEED,
    CLOSED_LOOP_SEED,
    DEVELOPMENT_SEED,
    FIRST_TEST_SEED,
    evaluation_seeds,
    tuning_seeds,
)


def test_ranges_of_seeds_are_apart():
    benchmark = evaluation_seeds("development", 0, 10_000)
    starts = [benchmark[0], DEVELOPMENT_SEED, CLOSED_LOOP_SEED, CALIBRATION_SEED, FIRST_TEST_SEED]
    assert starts == sorted(starts)
    assert all(later - earlier >= 10_000 for earlier, later in pairwise(starts[1:]))
    assert min(evaluation_seeds("test", 0, 1)) >= FIRST_TEST_SEED


def test_a_benchmark_stays_in_its_split():
    assert evaluation_seeds("development", 99_999, 1) == range(199_999, 200_000)
    with refused("seed"):
        evaluation_seeds("development", 99_999, 2)
    with refused("split"):
        evaluation_seeds("train", 0, 1)


def test_tuning_refuses_a_test_seed():
    assert tuning_seeds(199_998, 2) == range(199_998, 200_000)
    with refused("seed"):
        tuning_seeds(199_999, 2)
