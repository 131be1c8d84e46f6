"""The benchmark of an acceleration: finalists against dense, until their verdicts are reached."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse.control.queries import answer
from torchrl_sparse.evaluation.accelerate.request import Request
from torchrl_sparse.evaluation.benchmarks.benchmark import BenchmarkOptions, Episodes
from torchrl_sparse.evaluation.benchmarks.diffusion import DiffusionBenchmark
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense
from torchrl_sparse.evaluation.latency.measure import Latency, Machine
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.schema import DENSE, Results
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["Finalists"]


class Finalists(DiffusionBenchmark):
    """Benchmark of methods that were timed before, on the demonstrations' policy calls and with the candidates that do not
    play.

    Args:
        request: what was asked for.
        methods: name -> policy, dense among them.
        make_env, out: see `Benchmark`.
        machine, timings: where and how long a call of each method took.
        queries: [Q], with dense's answers.
    """

    def __init__(
        self,
        request: Request,
        methods: Mapping[str, DiffusionPolicy],
        make_env: Callable[..., EnvBase],
        out: Path,
        *,
        machine: Machine,
        timings: Mapping[str, Latency],
        queries: TensorDictBase,
    ) -> None:
        shared = ("task", "n_action_steps", "seed", "episodes", "margin", "time_margin", "threads", "workers")
        options = BenchmarkOptions(
            **{name: getattr(request, name) for name in shared},
            out=out,
            until="conclusive",
            max_episodes=request.episodes,
            num_envs=1,  # in a batch all would be stepped on until the last, perhaps a failure, ends
            device=str(methods[DENSE].device),
            latency_repeats=request.repeats,
        )
        super().__init__(options, methods, make_env, calibration=None)
        self._machine, self.timings, self.queries = machine, timings, queries
        self.settings |= {"task": self.task.name, "horizon": self.terms.episode_horizon}

    def measure(self, episodes: Episodes) -> dict[str, MethodRun]:
        queries = self.queries
        errors = {name: error_to_dense(m, answer(m, queries), queries) for name, m in self.methods.items()}
        return {name: MethodRun(episodes[name], self.timings[name], errors[name]) for name in self.methods}

    def draw(self, results: Results, episodes: Episodes) -> None:
        """Draw nothing: the acceleration's own figure shows all candidates."""

    def machine(self) -> Machine:
        return self._machine
