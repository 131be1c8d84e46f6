"""A benchmark of a vision-language-action policy: methods that match each other, and what is measured of all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import torch
from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.control.queries import answer
from torchrl_sparse.evaluation.latency.measure import Latency, measure_latency
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, token_totals
from torchrl_sparse.evaluation.rollouts.vla_methods import matching_share, mid_episode_query
from torchrl_sparse.methods.vla import Settings, TokenMethodName, make_pruner
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.vla.token_budget import replay

__all__ = ["matched_number", "matches_last", "replay_all", "time_methods"]


def matched_number(
    text: str,
    dense: VLAPolicy,
    recorded: Sequence[Sequence[TensorDictBase]],
    episodes: Mapping[str, Sequence[EpisodeResult]],
    settings: Settings,
) -> float | None:
    """Return a method's number: its own, or the share at which it keeps as many tokens as the method that it matches.

    Args:
        text: the method, see `torchrl_sparse.methods.vla`.
        dense: the dense policy.
        recorded: queries of dense episodes, see `recorded_queries`.
        episodes: name -> episodes, those of the method that is matched among them.
        settings: see `make_pruner`.
    """
    written = TokenMethodName.parse(text)
    if written.like is None:
        return written.number
    kept = token_totals(episodes[written.like]).mean
    return matching_share(
        lambda share: make_pruner(text, number=share, settings=settings), dense, recorded, kept
    )


def matches_last(texts: Iterable[str]) -> list[str]:
    """Return methods in the order in which they can run: those that match another after all others."""
    return sorted(texts, key=lambda text: TokenMethodName.parse(text).like is not None)


def time_methods(
    policies: Mapping[str, VLAPolicy],
    recorded: Sequence[Sequence[TensorDictBase]],
    *,
    repeats: int,
    threads: int,
    device: str,
) -> dict[str, Latency]:
    """Time the middle query of the first recorded episode under each method, interleaved.

    Args:
        policies: name -> policy.
        recorded: queries of dense episodes, see `recorded_queries`.
        repeats, threads, device: see `measure_latency`.
    """
    calls = {name: partial(answer, p, mid_episode_query(p, recorded[0])) for name, p in policies.items()}
    with progress("latency", "round", repeats) as show:
        return measure_latency(calls, repeats=repeats, threads=threads, device=device, on_round=show)


def replay_all(policy: VLAPolicy, recorded: Sequence[Sequence[TensorDictBase]]) -> TensorDictBase:
    """Return the policy's answers to all queries of all episodes, [Q]: chunks, and how deep each token went."""
    wanted = (keys.CHUNK, keys.TOKEN_DEPTH)
    return torch.cat([replay(policy, queries, policy.pruner).select(*wanted) for queries in recorded])
