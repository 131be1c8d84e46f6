"""Every use that the pinned tests make of the library. Code that moves or is renamed is followed here and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.cli.sweeps import Trial, merge_trials
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.build import MethodRun, Terms, build_results, compare_pair
from torchrl_sparse.evaluation.results.engine_report import format_engine_table, load_engine_results
from torchrl_sparse.evaluation.results.realtime import format_realtime, load_realtime
from torchrl_sparse.evaluation.results.report import comparison_rows, format_table
from torchrl_sparse.evaluation.results.schema import Results, load_results
from torchrl_sparse.evaluation.results.tables import markdown_table, select_columns
from torchrl_sparse.evaluation.results.tracking import trial_metrics
from torchrl_sparse.evaluation.results.vla_report import format_vla_table, load_vla_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.rollouts.vla_methods import matching_share
from torchrl_sparse.evaluation.statistics.sequential import Design
from torchrl_sparse.methods.diffusion import make_controller, make_method
from torchrl_sparse.methods.token_budget import TokenBudget
from torchrl_sparse.methods.vla import (
    make_controller as make_token_controller,
    make_pruner,
    parse_token_method,
)
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.json import to_plain

__all__ = [
    "EpisodeResult",
    "Trial",
    "diffusion_actor",
    "diffusion_answer",
    "diffusion_query",
    "episodes_of",
    "format_engine_table",
    "format_realtime",
    "format_table",
    "format_vla_table",
    "load_engine_results",
    "load_realtime",
    "load_results",
    "load_vla_results",
    "merge_trials",
    "native_available",
    "pairs_against",
    "results_of",
    "to_plain",
    "trial_metrics",
    "vla_actor",
    "vla_answer",
    "vla_query",
]

_NUM_UPDATES = 10  # M, as benchmark.yaml has it


# -- diffusion policies ------------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)  # one for each engine
def _policy(folder: Path, engine: str) -> DiffusionPolicy:
    return DiffusionPolicy.from_pretrained(folder, engine=engine)


def diffusion_actor(folder: Path, planners: Path, name: str, engine: str) -> ChunkExecutor:
    """The method ``name`` as `recipes/benchmark.py` makes it, with a policy call at every step, from files in ``planners``."""

    def calibration() -> None:
        raise AssertionError(f"{name}: expected a shipped schedule, got one to compute")

    policy = make_method(
        name, _policy(folder, engine), num_updates=_NUM_UPDATES, planners=planners, calibration=calibration
    )
    return ChunkExecutor(policy, n_action_steps=1, controller=make_controller(name))


def diffusion_query(
    state: Any, eef_vel: Any, seed: int, step: int, images: Tensor | None = None
) -> TensorDict:
    """What the environment shows at a step, [], with what a gate remembers of those before; images u8 [2, 3, h, w] stand."""
    query = TensorDict({keys.HISTORY_STATE: torch.tensor(state), keys.EEF_VEL: torch.tensor(eef_vel)}, [])
    for name, image in zip(("image", "wrist_image"), () if images is None else images, strict=False):
        query.set(keys.history(name), torch.stack([image] * len(state)))
    return _at_step(query, seed, step)


def diffusion_answer(actor: ChunkExecutor, query: TensorDictBase) -> dict[str, Tensor]:
    """The normalised chunk [*B, n, A], the mask [*B, K, 3L], the FLOPs [*B, 1] and the seed [*B, 1] of a policy call [*B]."""
    answer = actor(query)
    return {
        "chunk": actor.policy.normalizer.normalize_action(answer[keys.CHUNK]),
        "mask": answer[keys.PRUNE_MASK],
        "flops": answer[keys.FLOPS],
        "seed": answer[keys.SEED],
    }


def _at_step(query: TensorDict, seed: int, step: int) -> TensorDict:
    query.set(keys.EPISODE_SEED, torch.tensor([seed]))
    query.set(keys.EPISODE_STEP, torch.tensor([step]))
    query.set(keys.IS_INIT, torch.tensor([step == 0]))
    query.set(keys.AGE, torch.tensor([-1]))  # nothing was asked before
    return query.set(keys.CONTROL_STEP, torch.tensor([step - 1]))


# -- vision-language-action policies -----------------------------------------------------------------------------------


@cache
def _vla(folder: Path) -> VLAPolicy:
    return VLAPolicy.from_pretrained(folder, engine="torch")


def vla_actor(folder: Path, name: str, recorded: Sequence[TensorDictBase], kept: float) -> ChunkExecutor:
    """The method ``name`` as `recipes/benchmark_vla.py` makes it, with a policy call at every step.

    A method that matches another keeps ``kept`` tokens on the ``recorded`` calls. ``NAME.json`` is a calibrated budget.
    """
    if name.endswith(".json"):
        pruner = TokenBudget.from_pretrained(folder / name).pruner()
        return ChunkExecutor(_vla(folder).with_pruner(pruner), 1)
    number = None
    if parse_token_method(name).like is not None:
        number = matching_share(lambda share: make_pruner(name, number=share), _vla(folder), [recorded], kept)
    return ChunkExecutor(
        _vla(folder).with_pruner(make_pruner(name, number=number)), 1, make_token_controller(name)
    )


def vla_query(images: Tensor, state: Any, instruction: str, eef_vel: Any, seed: int, step: int) -> TensorDict:
    """The same as `diffusion_query`, with images u8 [2, 3, h, w] and an instruction."""
    query = TensorDict({keys.STATE: torch.tensor(state), keys.EEF_VEL: torch.tensor(eef_vel)}, [])
    query.set(keys.IMAGE, images[0]).set(keys.WRIST_IMAGE, images[1])
    return _at_step(query.set(keys.INSTRUCTION, instruction), seed, step)


def vla_answer(actor: ChunkExecutor, query: TensorDictBase, last: TensorDictBase | None) -> dict[str, Tensor]:
    """The same; the mask says how many layers ran on each visual token, and ``last`` is the step before."""
    policy = actor.policy
    if last is not None:
        carried = [key for key in policy.out_keys if key in policy.in_keys]
        query.update(last.select(*carried, keys.FINE, strict=False))
    answer = actor(query)
    return {
        "chunk": policy.normalizer.normalize_action(answer[keys.CHUNK]),
        "mask": answer[keys.TOKEN_DEPTH],
        "flops": answer[keys.FLOPS],
    }


# -- episodes and results ----------------------------------------------------------------------------------------------


def episodes_of(log: Path) -> list[EpisodeResult]:
    """All episodes of a log, by seed."""
    return sorted(read_episodes(log), key=lambda episode: episode.seed)


def results_of(episodes: dict[str, list[EpisodeResult]], like: Results) -> Results:
    """The content of a ``results.json`` about them, as if every policy call took a second; the rest is that of ``like``."""
    second = summarize_latency([1.0])
    runs = {name: MethodRun(of_method, second, (0.0, 0.0)) for name, of_method in episodes.items()}
    about = {name: getattr(like, name) for name in ("task", "split", "seed", "machine", "policy")}
    terms = Terms(Design(len(episodes["dense"])), like.episode_horizon, like.early_cut)
    return build_results(runs, terms=terms, **about)


_OF_PAIRS = ("method", "against", "success", "difference, points", "verdict", "McNemar's p")


def pairs_against(other: str, episodes: dict[str, list[EpisodeResult]], horizon: int) -> str:
    """A table of each method's difference in success to one of them, paired by seed."""
    terms = Terms(Design(len(episodes[other])), horizon)
    pairs = [compare_pair(name, each, other, episodes[other], terms) for name, each in episodes.items()]
    return markdown_table(select_columns(comparison_rows(pairs), _OF_PAIRS))
