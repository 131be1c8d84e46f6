"""A small grid, what is asked for, and episodes without a simulator."""

from torchrl_sparse.evaluation.accelerate import Grid, Request
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult

HORIZON = 40
GRID = Grid(
    samplers=("ddpm2_logsnr", "ddim4"),
    searched=("ddpm2",),
    cached=("ddpm4",),
    updates=(2, 9),
    intervals=(2, 6),
    rounded=(),
    strides=(40,),
)
METHODS = [
    *("dense", "ddpm2_logsnr", "ddim4", "uniform2", "uniform6", "bac2", "uniform2_ddpm4", "bac2_ddpm4"),
]


def ask(**changes):
    return Request("lift", **{"n_action_steps": 4, "windows": 12, "repeats": 3, "finalists": 2, **changes})


def fixed_times(milliseconds):
    """Latencies of methods by name, in the place of `time_queries`; 50 ms of those that are not named."""

    def time_queries(methods, queries, *, repeats, threads, on_round):
        return {name: summarize_latency([milliseconds.get(name, 50.0) / 1e3] * repeats) for name in methods}

    return time_queries


def episodes_of(lengths):
    """Episodes by method, in the place of `evaluate`: solved after so many steps, or not at all (None)."""

    def evaluate(name, actor, make_env, seeds, **options):
        length = lengths.get(name)
        solved = length is not None
        return [EpisodeResult(seed, solved, length or HORIZON, 5, 10.0, 0.0) for seed in seeds]

    return evaluate
