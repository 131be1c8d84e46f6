"""The benchmark of methods under inference delay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torchrl.envs import EnvBase

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.control.realtime_executor import HoldPose, RealtimeExecutor, delay_steps
from torchrl_sparse.control.roll_forward import StateModel
from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.envs.tasks import RobosuiteTask
from torchrl_sparse.evaluation.benchmarks.benchmark import Benchmark, BenchmarkOptions, Episodes
from torchrl_sparse.evaluation.benchmarks.diffusion import time_methods
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.results.realtime import Realtime, RealtimeRun, build_realtime
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log
from torchrl_sparse.methods.diffusion import method_identity
from torchrl_sparse.methods.executor import executed_every, make_realtime_executor
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.trainer import checksum

__all__ = ["RealtimeBenchmark"]


class RealtimeBenchmark(Benchmark):
    """Benchmark of a diffusion policy under several methods, each at its own and at other latencies.

    Each method is timed before it plays, since its own latency is one of those that it plays under. What plays is a method
    at a number of steps of delay.

    Args:
        options: see `Benchmark`.
        task: in which a pose can be held.
        methods: name -> policy, see `make_methods`.
        make_env: see `Benchmark`.
        latencies: seconds, beside each method's own.
        model: of `make_realtime_executor`.
    """

    file = "realtime.json"

    def __init__(
        self,
        options: BenchmarkOptions,
        task: RobosuiteTask,
        methods: Mapping[str, DiffusionPolicy],
        make_env: Callable[..., EnvBase],
        latencies: Sequence[float],
        model: StateModel | None = None,
    ) -> None:
        super().__init__(options, task, make_env)
        self.methods, self.latencies, self.model = methods, latencies, model

    def play(self) -> dict[str, dict[int, list[EpisodeResult]]]:
        """Return the episodes by method and delay in steps."""
        options, dense = self.options, ChunkExecutor(self.methods[DENSE])
        queries = record_queries(dense, self.make_env, self.seeds[: options.probe_episodes])
        timing = {"repeats": options.latency_repeats, "threads": options.threads}
        self.latency = time_methods(self.methods, queries, **timing)
        episodes: dict[str, dict[int, list[EpisodeResult]]] = {}
        with self.runtime():
            for name in self.methods:
                delays = delay_steps(torch.tensor([self.latency[name].p50, *self.latencies]), CONTROL_FREQ)
                episodes[name] = {}
                for steps in delays.unique().tolist():
                    episodes[name][steps] = self.play_method(f"{name} +{steps}", len(self.seeds))
        return episodes

    def measure(
        self, episodes: Mapping[str, Mapping[int, Sequence[EpisodeResult]]]
    ) -> dict[str, RealtimeRun]:
        return {name: RealtimeRun(self.latency[name].p50, played) for name, played in episodes.items()}

    def results(self, runs: Mapping[str, RealtimeRun]) -> Realtime:
        """Compare the methods at every delay: the content of ``realtime.json``."""
        options = self.options
        return build_realtime(
            runs,
            task=self.task.name,
            split=options.split,
            seed=options.seed,
            control_freq=CONTROL_FREQ,
            n_action_steps=options.n_action_steps,
            machine=self.machine(),
            terms=self.terms,
        )

    def draw(self, results: Realtime, episodes: Episodes) -> None:
        plot_realtime(results, self.out / "realtime.png")

    def dense(self) -> DiffusionPolicy:
        return self.methods[DENSE]

    def actor(self, name: str) -> RealtimeExecutor:
        method, steps = _delayed(name)
        return make_realtime_executor(
            method,
            self.methods[method],
            self.options.n_action_steps,
            hold=HoldPose(self.task.pose_slices()),
            latency=steps / CONTROL_FREQ,
            control_freq=CONTROL_FREQ,
            model=self.model,
        )

    def identity(self, name: str) -> dict[str, Any]:
        method, steps = _delayed(name)
        every = executed_every(method, self.methods[method], self.options.n_action_steps)
        late = {"n_action_steps": every, "delay_steps": steps}
        if MethodSpec.parse(method).ahead:
            late["state_model"] = checksum(self.model.weight)
        return method_identity(method, self.methods[method]) | self.settings | late

    def log(self, name: str) -> Any:
        method, steps = _delayed(name)
        return episode_log(self.out, f"{method}_delay{steps}")


def _delayed(name: str) -> tuple[str, int]:
    """Return the method and its steps of delay."""
    method, _, steps = name.rpartition(" +")
    return method, int(steps)
