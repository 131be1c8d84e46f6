"""Which seeds are whose, so that nothing is tested on episodes that something else was chosen or trained on.

An episode is fixed by its seed. Demonstrations begin at 0; each constant here is the first seed of one other use.
"""

__all__ = [
    "CALIBRATION_SEED",
    "DEVELOPMENT_SEED",
    "EVALUATION_SEED",
    "PRUNER_ROLLOUT_SEED",
    "TOKEN_CALIBRATION_SEED",
    "evaluation_seeds",
]

EVALUATION_SEED = 100_000
"""Of benchmarks: Diffusion Policy's ``test_start_seed``."""

TOKEN_CALIBRATION_SEED = 300_000
"""Of the episodes that SpecPrune's alpha is chosen on."""

CALIBRATION_SEED = 1_000_000
"""Of the first observations that cache schedules are computed from."""

PRUNER_ROLLOUT_SEED = 2_000_000
"""Of the episodes whose observations a pruner is trained on."""

DEVELOPMENT_SEED = 3_000_000
"""Of the episodes on which checkpoints and settings are chosen."""


def evaluation_seeds(offset: int, episodes: int) -> range:
    """The seeds of a benchmark's episodes; a second benchmark with another ``offset`` may extend the first.

    >>> evaluation_seeds(200, 3)
    range(100200, 100203)
    """
    first = EVALUATION_SEED + offset
    return range(first, first + episodes)
