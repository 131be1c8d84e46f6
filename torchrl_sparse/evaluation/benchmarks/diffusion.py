"""The benchmark of a diffusion policy: methods, measurements and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.calibration import Calibration
from torchrl_sparse.blocks.saved import saved_planners
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer, record_queries
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.benchmarks.benchmark import Benchmark, BenchmarkOptions, Episodes
from torchrl_sparse.evaluation.benchmarks.film import film_masks
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense, flops_executed
from torchrl_sparse.evaluation.figures.curves import plot_success_within
from torchrl_sparse.evaluation.figures.masks import plot_mask_statistics, plot_mask_strip
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.plots import (
    plot_error_surge,
    plot_schedule,
    plot_similarity,
)
from torchrl_sparse.evaluation.figures.ways import count_modes, plot_ways
from torchrl_sparse.evaluation.latency.measure import Latency
from torchrl_sparse.evaluation.latency.queries import time_planning, time_queries
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.schema import DENSE, Results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.statistics.fidelity import block_errors
from torchrl_sparse.methods.diffusion import make_method, method_identity
from torchrl_sparse.methods.executor import make_executor
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress

__all__ = [
    "DiffusionBenchmark",
    "default_methods",
    "draw_methods",
    "make_methods",
    "measure_methods",
    "settle_rates",
    "time_methods",
]

_ALWAYS = ("dense", "dense_noise", "ddim10", "uniform", "bac_unified", "bac_blockwise", "bac")
_SAME_COMPUTATION = {"dense_noise": "dense"}  # of other numbers: it takes as long, and is not timed again
_SURGING = ("uniform", "bac_blockwise", "bac")  # whose errors BAC's third figure compares


class DiffusionBenchmark(Benchmark):
    """Benchmark of a diffusion policy, dense against other methods, without inference delay.

    Args:
        options, make_env: see `Benchmark`.
        methods: name -> policy, see `make_methods`.
        calibration: of the dense policy, whose similarities `draw` shows; called once, at the end. None where it draws nothing.

    Raises:
        InputError: see `make_executor`.
    """

    def __init__(
        self,
        options: BenchmarkOptions,
        methods: Mapping[str, DiffusionPolicy],
        make_env: Callable[..., EnvBase],
        calibration: Callable[[], Calibration] | None,
    ) -> None:
        self.methods, self.calibration, self.names = methods, calibration, methods
        self.actors = {
            name: make_executor(name, method, options.n_action_steps) for name, method in methods.items()
        }
        super().__init__(options, find_task(options.task), make_env)

    def dense(self) -> DiffusionPolicy:
        return self.methods[DENSE]

    def actor(self, name: str) -> ChunkExecutor:
        return self.actors[name]

    def identity(self, name: str) -> dict[str, Any]:
        executed = {"n_action_steps": self.actors[name].n_action_steps}
        return method_identity(name, self.methods[name]) | self.settings | executed

    def measure(self, episodes: Episodes) -> dict[str, MethodRun]:
        options = self.options
        settle_rates(self.methods, episodes)
        probed = self.seeds[: options.probe_episodes]
        self.queries = record_queries(self.actors[DENSE], self.make_env, probed)
        timing = {"repeats": options.latency_repeats, "threads": options.threads}
        return measure_methods(self.methods, episodes, self.queries, **timing)

    def draw(self, results: Results, episodes: Episodes) -> None:
        draw_methods(results, self.methods, self.queries, self.calibration(), self.out)
        if ways := count_modes(episodes):
            title = f"{results.task}, {results.split} seeds: ways that were taken"
            plot_ways(ways, self.out / "ways.png", title=title)
        self.film(self.options.videos)

    def film(self, names: Sequence[str]) -> None:
        """Film one episode of each measured method that is named, if there is a GL library."""
        if left_out := [name for name in names if name not in self.actors]:
            print(f"no video of {', '.join(left_out)}: not among the methods")
        try:
            for name in filter(self.actors.__contains__, names):
                first, threads = self.seeds[0], self.options.threads
                film_masks(name, self.actors[name], self.make_env, first, self.out, threads)
        except RuntimeError as error:  # no GL library
            print(f"no video: {error}")


def default_methods(planners: Path) -> list[str]:
    """Return the methods that need no file, and every planner saved in a folder.

    >>> default_methods(Path("assets/lift"))[5:]
    ['bac_blockwise', 'bac', 'bac_ddpm10', 'bac_m6', 'l2c', 'l2c_noise', 'sag', 'sag_fixed', 'searched']
    """
    return list(dict.fromkeys([*_ALWAYS, *saved_planners(planners)]))


def make_methods(
    names: Iterable[str],
    policy: DiffusionPolicy,
    *,
    num_updates: int,
    planners: Path,
    calibration: Callable[[], Calibration],
) -> dict[str, DiffusionPolicy]:
    """Return the policy under each method, starting with the unchanged policy, dense, as the reference.

    Args:
        names: of methods; the rest as of `make_method`.
    """
    options = {"num_updates": num_updates, "planners": planners, "calibration": calibration}
    return {name: make_method(name, policy, **options) for name in dict.fromkeys(["dense", *names])}


def settle_rates(
    methods: Mapping[str, DiffusionPolicy], episodes: Mapping[str, Sequence[EpisodeResult]]
) -> None:
    """Set the rate of each method with a rate controller to the mean of its episodes; it is then timed at that rate."""
    for name, method in methods.items():
        rates = MethodSpec.parse(name).rates
        if len(rates) == 2:
            method.plan.rate = min(max(totals(episodes[name]).prune_rate, min(rates)), max(rates))


def time_methods(
    methods: Mapping[str, DiffusionPolicy], queries: TensorDictBase, *, repeats: int, threads: int
) -> dict[str, Latency]:
    """Time every method, interleaved; methods that compute the same share one latency.

    Args:
        methods: name -> policy, ``"dense"`` among them.
        queries: [Q] of dense episodes.
        repeats: policy calls that are timed under each method.
        threads: of PyTorch while timing.
    """
    samples = {name: MethodSpec.parse(name).samples for name in methods}
    timed = {name: method for name, method in methods.items() if name not in _SAME_COMPUTATION}
    with progress("latency", "round", repeats) as show:
        latency = time_queries(
            timed, queries, repeats=repeats, threads=threads, samples=samples, on_round=show
        )
    return {name: latency[_SAME_COMPUTATION.get(name, name)] for name in methods}


def measure_methods(
    methods: Mapping[str, DiffusionPolicy],
    episodes: Mapping[str, Sequence[EpisodeResult]],
    queries: TensorDictBase,
    *,
    repeats: int,
    threads: int,
) -> dict[str, MethodRun]:
    """Measure latency and action error of all methods on the same policy calls, and add both to the episodes.

    Args:
        methods: name -> policy, ``"dense"`` among them.
        episodes: name -> its episodes.
        queries: [Q] of dense episodes, with the dense policy's answers; see `record_queries`.
        repeats: calls that are timed under each method.
        threads: of PyTorch while timing.
    """
    latency = time_methods(methods, queries, repeats=repeats, threads=threads)
    planning = time_planning(_adaptive(methods), queries, threads=threads)
    answers = {name: answer(method, queries) for name, method in methods.items()}
    return {
        name: MethodRun(
            episodes[name],
            latency[name],
            error_to_dense(method, answers[name], queries),
            planning.get(name),
            MethodSpec.parse(name).every,
            MethodSpec.parse(name).samples * flops_executed(method, answers[name]),
        )
        for name, method in methods.items()
    }


def draw_methods(
    results: Results,
    methods: Mapping[str, DiffusionPolicy],
    queries: TensorDictBase,
    calibration: Calibration,
    out: Path,
) -> None:
    """Write the figures: success against time, every method's mask, mask changes, and error surges.

    Args:
        results: content of ``results.json``.
        methods: name -> policy, ``"dense"`` among them.
        queries: [Q] of dense episodes, in order.
        calibration: of the dense policy, whose similarities are drawn.
        out: folder of the figures.
    """
    plot_pareto(results, out / "pareto.png")
    plot_success_within(results, out / "success_within.png")
    types = methods["dense"].network.block_types
    plot_similarity(calibration.similarity.numpy(), out / "similarity.png", types)
    # The first policy call of an episode has no last chunk to begin from.
    masks = {name: answer(method, queries[:2])[keys.PRUNE_MASK][-1] for name, method in methods.items()}
    for name, mask in masks.items():
        ratio = results.methods[name].flops.ratio_to_dense
        plot_schedule(mask.numpy(), out / f"schedule_{name}.png", name=name, flops_ratio=ratio, types=types)
    for name, method in _adaptive(methods).items():
        _draw_masks(name, method, queries, out)
    surging = {name: masks[name] for name in _SURGING if name in masks}
    if surging:
        dense = methods["dense"]
        noise = dense.sample_noise(queries[keys.SEED].squeeze(-1))
        errors = block_errors(dense.network, dense.sampler, noise, queries[keys.COND], surging)
        plot_error_surge(
            {name: error.numpy() for name, error in errors.items()},
            {name: mask.numpy() for name, mask in surging.items()},
            out / "error_surge.png",
            types,
        )


def _adaptive(methods: Mapping[str, DiffusionPolicy]) -> dict[str, DiffusionPolicy]:
    """Return those whose masks depend on the observation."""
    return {name: method for name, method in methods.items() if not method.plan.is_static}


def _draw_masks(name: str, method: DiffusionPolicy, queries: TensorDictBase, out: Path) -> None:
    """Draw the masks along an episode, and their statistics over all policy calls."""
    masks, types = answer(method, queries)[keys.PRUNE_MASK].numpy(), method.network.block_types
    plot_mask_statistics(masks, out / f"masks_{name}.png", name=name, types=types)
    step = queries[keys.EPISODE_STEP].flatten()
    first_episode = (queries[keys.EPISODE_SEED] == queries[keys.EPISODE_SEED][0]).flatten()
    steps_per_query = int(step[1] - step[0]) if first_episode.sum() > 1 else 1
    strip = masks[first_episode.numpy()]
    plot_mask_strip(strip, out / f"strip_{name}.png", name=name, steps_per_query=steps_per_query, types=types)
