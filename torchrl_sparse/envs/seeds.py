"""Ranges of seeds by the purpose of their episodes: nothing is tested on what it was trained or tuned on.

Demonstrations begin at seed 0. Ranges are far longer than anybody's number of episodes.
"""

EVALUATION_SEED = 100_000  # of benchmarks, and of nothing else: Diffusion Policy's test_start_seed
DEVELOPMENT_SEED = 200_000  # of evaluations during training, and of sweeps
CALIBRATION_SEED = 1_000_000  # of the observations that cache schedules are computed from
CLOSED_LOOP_SEED = 2_000_000  # of the episodes that a pruner is trained on


def evaluation_seeds(offset: int, episodes: int) -> range:
    """Return the seeds of a benchmark's episodes; a second benchmark with another ``offset`` may extend the first.

    >>> evaluation_seeds(200, 3)
    range(100200, 100203)
    """
    first = EVALUATION_SEED + offset
    return range(first, first + episodes)
