"""What is measured of the methods of a vision-language-action policy on recorded queries: time, distance to dense, depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.control.queries import answer
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense
from torchrl_sparse.evaluation.benchmarks.vla import Recorded
from torchrl_sparse.evaluation.figures.curves import plot_success_within
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.tokens import plot_tokens_per_layer
from torchrl_sparse.evaluation.latency.measure import Latency, measure_latency
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.schema import DENSE, Results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.vla_methods import prepared_queries
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.vla.token_budget import replay

__all__ = ["draw_methods", "measure_methods", "replay_all", "time_methods"]


def measure_methods(
    policies: Mapping[str, VLAPolicy],
    recorded: Mapping[str, Recorded],
    episodes: Mapping[str, Sequence[EpisodeResult]],
    *,
    repeats: int,
    threads: int,
    device: str,
) -> dict[str, MethodRun]:
    """Measure each method's time and its distance to dense, on its own queries.

    Args:
        policies: name -> policy, the dense one among them.
        recorded: name -> the method's queries, see `record_methods`.
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
    """Draw success against time, time to success, and how deep each method's tokens go, into the folder ``out``."""
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
    """Time the queries of the first recorded episode in turn, each method its own, interleaved.

    So the times are those of an episode's mixture of queries: the first, which knows nothing of the scene and may keep more,
    coarse and fine ones.

    Args:
        policies: name -> policy.
        recorded: name -> the method's queries, see `record_methods`.
        repeats, threads, device: see `measure_latency`.
    """
    calls = {name: _in_turn(policy, recorded[name][0]) for name, policy in policies.items()}
    with progress("latency", "round", repeats) as show:
        return measure_latency(calls, repeats=repeats, threads=threads, device=device, on_round=show)


def _in_turn(policy: VLAPolicy, queries: Sequence[TensorDictBase]) -> Callable[[], TensorDictBase]:
    """Return a function whose calls answer one query of an episode after the other, and begin anew after the last."""
    endless = cycle(prepared_queries(policy, queries))
    return lambda: answer(policy, next(endless))


def replay_all(policy: VLAPolicy, recorded: Recorded) -> TensorDictBase:
    """Return the policy's answers to all queries of all episodes, [Q]: chunks, and how deep each token went."""
    wanted = (keys.CHUNK, keys.TOKEN_DEPTH)
    return torch.cat([replay(policy, queries, policy.pruner).select(*wanted) for queries in recorded])
