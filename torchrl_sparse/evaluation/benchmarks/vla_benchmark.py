"""The benchmark of a vision-language-action policy: success, and on recorded calls time, distance to dense, and token depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer
from torchrl_sparse.envs.instructed import InstructedTask
from torchrl_sparse.evaluation.benchmarks.benchmark import Benchmark, BenchmarkOptions, Episodes
from torchrl_sparse.evaluation.benchmarks.film import film_tokens
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense
from torchrl_sparse.evaluation.benchmarks.vla import (
    Recorded,
    check_budgets,
    filmed_methods,
    matched_number,
    matches_last,
    record_methods,
    skipped_layers,
)
from torchrl_sparse.evaluation.figures.curves import plot_success_within
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.tokens import plot_tokens_per_layer
from torchrl_sparse.evaluation.latency.measure import Latency, measure_latency
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.schema import DENSE, Results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.vla_methods import method_identity, prepared_queries
from torchrl_sparse.methods.vla import Settings, make_controller, make_pruner, parse_token_method
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.vla.token_budget import replay

__all__ = ["VLABenchmark", "draw_methods", "measure_methods", "replay_all", "time_methods"]


class VLABenchmark(Benchmark):
    """Benchmark of a vision-language-action policy, dense against pruned visual tokens.

    Policy calls are recorded before methods play, since a method that matches another's tokens needs both.

    Args:
        options, make_env: see `Benchmark`.
        task: in results under the name that was asked for.
        dense: the policy, which prunes nothing.
        methods: as they are written, dense among them.
        pruning: settings of pruners and controllers, see `token_settings`.
        skipped: decoder layers that ``efficientvla_layers`` leaves out.

    Raises:
        InputError: see `check_budgets` and `filmed_methods`.
    """

    def __init__(
        self,
        options: BenchmarkOptions,
        task: InstructedTask,
        dense: VLAPolicy,
        methods: Sequence[str],
        make_env: Callable[..., EnvBase],
        *,
        pruning: Settings,
        skipped: int,
    ) -> None:
        check_budgets(methods, dense.network.config.visual_spec, pruning)
        super().__init__(options, replace(task, name=options.task), make_env)
        self.methods, self.names = methods, matches_last(methods)
        self.pruning, self.skipped = dict(pruning), skipped
        self._dense, self.filmed = dense, filmed_methods(options.videos, methods)
        self.actors: dict[str, ChunkExecutor] = {}
        self.numbers: dict[str, float | None] = {}
        self.played: dict[str, list[EpisodeResult]] = {}

    def play(self) -> Episodes:
        dense, probed = self._dense, self.seeds[: self.options.probe_episodes]
        asked = {"n_action_steps": self.options.n_action_steps, "settings": self.pruning}
        self.recorded = record_methods(self.methods, dense, self.make_env, probed, **asked)
        if any(parse_token_method(name).name == "efficientvla_layers" for name in self.methods):
            skipped = skipped_layers(dense, self.recorded[DENSE], self.skipped)
            self.pruning["efficientvla"] = {"skipped": skipped}
        return super().play()

    def play_method(self, name: str, count: int) -> list[EpisodeResult]:
        self.played[name] = super().play_method(name, count)
        return self.played[name]

    def measure(self, episodes: Episodes) -> dict[str, MethodRun]:
        self.policies = {name: self.actors[name].policy for name in self.methods}  # in the order asked for
        options = self.options
        timing = {"repeats": options.latency_repeats, "threads": options.threads, "device": options.device}
        return measure_methods(self.policies, self.recorded, episodes, **timing)

    def made_with(self) -> dict[str, Any]:
        return {**self.pruning, "numbers": self.numbers, "probe_episodes": self.options.probe_episodes}

    def draw(self, results: Results, episodes: Episodes) -> None:
        draw_methods(results, self.policies, self.recorded, self.out)
        for video, name in self.filmed.items():
            first, threads = self.seeds[0], self.options.threads
            film_tokens(video, self.actors[name], self.make_env, first, self.out, threads)

    def dense(self) -> VLAPolicy:
        return self._dense

    def actor(self, name: str) -> ChunkExecutor:
        if name not in self.actors:  # what it matches has been played
            dense, settings = self._dense, self.pruning
            number = matched_number(name, dense, self.recorded[name], self.played, settings)
            policy = dense.with_pruner(make_pruner(name, number=number, settings=settings))
            controller = make_controller(name, settings)
            self.actors[name] = ChunkExecutor(policy, self.options.n_action_steps, controller)
            self.numbers[name] = number
        return self.actors[name]

    def identity(self, name: str) -> dict[str, Any]:
        return method_identity(name, self.numbers[name], self._dense, self.pruning) | self.settings


def measure_methods(
    policies: Mapping[str, VLAPolicy],
    recorded: Mapping[str, Recorded],
    episodes: Mapping[str, Sequence[EpisodeResult]],
    *,
    repeats: int,
    threads: int,
    device: str,
) -> dict[str, MethodRun]:
    """Measure each method's time and its distance to dense on its own policy calls.

    Args:
        policies: name -> policy, the dense one among them.
        recorded: name -> the method's calls, see `record_methods`.
        episodes: name -> the method's episodes.
        repeats, threads, device: see `measure_latency`.
    """
    latency = time_methods(policies, recorded, repeats=repeats, threads=threads, device=device)
    dense = policies[DENSE]
    errors = {
        name: error_to_dense(dense, replay_all(policy, recorded[name]), replay_all(dense, recorded[name]))
        for name, policy in policies.items()
    }
    return {name: MethodRun(episodes[name], latency[name], errors[name]) for name in policies}


def draw_methods(
    results: Results, policies: Mapping[str, VLAPolicy], recorded: Mapping[str, Recorded], out: Path
) -> None:
    """Draw success against time, time to success, and each method's tokens per layer, into the folder ``out``."""
    plot_pareto(results, out / "pareto.png")
    plot_success_within(results, out / "success_within.png")
    depth = {
        name: replay_all(policy, recorded[name])[keys.TOKEN_DEPTH].numpy(force=True)
        for name, policy in policies.items()
    }
    plot_tokens_per_layer(depth, policies[DENSE].network.config.llm.layers, out / "tokens_per_layer.png")


def time_methods(
    policies: Mapping[str, VLAPolicy],
    recorded: Mapping[str, Recorded],
    *,
    repeats: int,
    threads: int,
    device: str,
) -> dict[str, Latency]:
    """Time each method on its own policy calls of the first recorded episode, interleaved.

    So the times are those of an episode's mixture of queries: the first, which knows nothing of the scene and may keep more,
    coarse and fine ones.

    Args:
        policies: name -> policy.
        recorded: name -> the method's calls, see `record_methods`.
        repeats, threads, device: see `measure_latency`.
    """
    calls = {name: _in_turn(policy, recorded[name][0]) for name, policy in policies.items()}
    with progress("latency", "round", repeats) as show:
        return measure_latency(calls, repeats=repeats, threads=threads, device=device, on_round=show)


def _in_turn(policy: VLAPolicy, queries: Sequence[TensorDictBase]) -> Callable[[], TensorDictBase]:
    """Return a function whose calls answer one policy call of an episode after the other, and begin again after the last."""
    endless = cycle(prepared_queries(policy, queries))
    return lambda: answer(policy, next(endless))


def replay_all(policy: VLAPolicy, recorded: Recorded) -> TensorDictBase:
    """Return the policy's outputs for all policy calls of all episodes, [Q]: chunks, and the depth that each token reached."""
    wanted = (keys.CHUNK, keys.TOKEN_DEPTH)
    return torch.cat([replay(policy, queries, policy.pruner).select(*wanted) for queries in recorded])
