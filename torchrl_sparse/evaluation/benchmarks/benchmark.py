"""The base of all benchmarks, in the order in which they run: play, measure, compare, draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_sparse.envs.seeds import Split, evaluation_seeds
from torchrl_sparse.envs.task import Task
from torchrl_sparse.evaluation.benchmarks.rounds import episode_horizon, make_design, play_rounds
from torchrl_sparse.evaluation.benchmarks.summary import describe_policy
from torchrl_sparse.evaluation.latency.measure import Machine, describe_machine
from torchrl_sparse.evaluation.results.build import MethodRun, Terms, build_results
from torchrl_sparse.evaluation.results.schema import Results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.storage.json import write_json

__all__ = ["Benchmark", "BenchmarkOptions"]

Episodes = Mapping[str, Sequence[EpisodeResult]]


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Options common to all benchmarks, named as in the recipes.

    Attributes:
        task: a name or alias, as it was asked for.
        out: folder of all that a benchmark leaves.
        n_action_steps: actions of a chunk that are executed.
        horizon: steps until an episode is truncated; None is the task's own.
        split, seed: see `evaluation_seeds`.
        until, episodes, max_episodes: see `make_design`.
        margin, time_margin: see `Terms`.
        num_envs, workers, backend: see `rollout_episodes`.
        device: of the policy.
        threads, latency_repeats: of the timing.
        probe_episodes: dense episodes whose policy calls are measured.
        dense_log: where dense's episodes are kept; None is with the others.
        pairs: of methods that are compared with each other.
        videos: methods to film.
    """

    task: str
    out: str | Path
    n_action_steps: int
    horizon: int | None = None
    split: Split = "development"
    seed: int = 0
    until: str = "episodes"
    episodes: int
    max_episodes: int | None = None
    margin: float
    time_margin: float
    num_envs: int = 1
    workers: int = 1
    backend: str = "process"
    device: str = "cpu"
    threads: int
    latency_repeats: int
    probe_episodes: int = 1
    dense_log: str | None = None
    pairs: Sequence[Sequence[str]] = ()
    videos: Sequence[str] = ()

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> BenchmarkOptions:
        """Select these options from a recipe's, which may have others too."""
        return cls(**{field.name: options[field.name] for field in fields(cls) if field.name in options})


class Benchmark(ABC):
    """Comparison of methods with dense on the same episodes and policy calls; `run` shows the order.

    A subclass has the methods: what acts them out, what tells their episodes from others', how they are timed, what is drawn.

    Args:
        options: see `BenchmarkOptions`.
        task: whose episodes are played.
        make_env: called as ``make_env(seeds=[...])``.

    Attributes:
        names: methods in the order in which they play.
        settings: what decides, beside the method, how an episode goes; JSON values.
        seeds: of all episodes that may be played.
        terms: of the comparison.
    """

    names: Iterable[str]
    file = "results.json"

    def __init__(self, options: BenchmarkOptions, task: Task, make_env: Callable[..., EnvBase]) -> None:
        self.options, self.task, self.make_env, self.out = options, task, make_env, Path(options.out)
        design = make_design(options.until, options.episodes, options.max_episodes)
        self.seeds = evaluation_seeds(options.split, options.seed, design.max_episodes)
        horizon, margins = episode_horizon(make_env, self.seeds), (options.margin, options.time_margin)
        self.terms = Terms(design, horizon, task.early_cut, *margins, task.graded)
        self.settings = {name: getattr(options, name) for name in ("task", "horizon", "n_action_steps")}

    def run(self) -> Results:
        """Play the episodes or read them from an earlier run's logs; then measure, compare, write and draw."""
        episodes = self.play()
        results = self.results(self.measure(episodes))
        write_json(self.out / self.file, results)
        self.draw(results, episodes)
        return results

    def play(self) -> Episodes:
        """Return the episodes of every method, dense first."""
        with self.runtime():
            return play_rounds(self.names, self.play_method, self.terms)

    @abstractmethod
    def measure(self, episodes: Episodes) -> Mapping[str, MethodRun]:
        """Time the methods and compare their actions with dense's; return the results together with the episodes."""

    def results(self, runs: Mapping[str, MethodRun]) -> Results:
        """Compare the methods: the content of ``results.json``."""
        options = self.options
        return build_results(
            runs,
            task=self.task.name,
            split=options.split,
            seed=options.seed,
            terms=self.terms,
            machine=self.machine(),
            policy=describe_policy(self.dense(), options.n_action_steps),
            pairs=options.pairs,
            settings=self.made_with(),
        )

    @abstractmethod
    def draw(self, results: Results, episodes: Episodes) -> None:
        """Draw and film into the folder."""

    @abstractmethod
    def dense(self) -> DiffusionPolicy | VLAPolicy:
        """Return the dense policy."""

    @abstractmethod
    def actor(self, name: str) -> TensorDictModuleBase:
        """Return the actor that plays a method."""

    @abstractmethod
    def identity(self, name: str) -> dict[str, Any]:
        """Return the values that tell a method's episodes from others', see `EpisodeLog`."""

    def play_method(self, name: str, count: int) -> list[EpisodeResult]:
        """Return a method's first ``count`` episodes; logged ones are not run again."""
        options = self.options
        return evaluate(
            name,
            self.actor(name),
            self.make_env,
            self.seeds[:count],
            log=self.log(name),
            identity=self.identity(name),
            num_envs=options.num_envs,
            policy_device=options.device,
            workers=options.workers,
            backend=options.backend,
        )

    def log(self, name: str) -> Path:
        """Return the log of a method's episodes."""
        return episode_log(self.out, name, self.options.dense_log)

    def runtime(self) -> Any:
        """Return the context in which workers run: one Ray cluster for all methods."""
        return backend_runtime(self.options.backend, self.options.workers)

    def machine(self) -> Machine:
        """Describe the machine of the measurements."""
        return describe_machine(self.options.device, self.options.threads)

    def made_with(self) -> dict[str, Any] | None:
        """Return the other settings that the methods depend on, for ``results.json``."""
        return None
