"""Set-up of a vision-language-action benchmark: its methods, which may match each other's tokens, and their policy calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, tokens_kept
from torchrl_sparse.evaluation.rollouts.vla_methods import matching_share
from torchrl_sparse.methods.token_budget import TokenBudget
from torchrl_sparse.methods.vla import (
    TOKEN_METHODS,
    Settings,
    make_controller,
    make_pruner,
    parse_token_method,
)
from torchrl_sparse.networks.vla.hooks import VisualSpec
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.efficientvla import SIMILARITY, LayerSimilarity, redundant_layers
from torchrl_sparse.tokens.selection import check_budget
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.training.vla.token_budget import recorded_queries, replay

__all__ = [
    "Recorded",
    "check_budgets",
    "filmed_methods",
    "matched_number",
    "matches_last",
    "record_methods",
    "skipped_layers",
    "token_settings",
]

Recorded = Sequence[Sequence[TensorDictBase]]
"""The policy calls, each [], of dense episodes."""


def record_methods(
    texts: Iterable[str],
    dense: VLAPolicy,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    n_action_steps: int,
    settings: Settings,
) -> dict[str, Recorded]:
    """Record the policy calls that each method is measured on: dense episodes under the method's own controller.

    The controller asks for calls of its own where motion becomes fine, and grants each its budget; both are replayed with
    it. Methods without one, and those with the same, share their episodes.

    Args:
        texts: of methods.
        dense: the dense policy, which acts.
        make_env: called as ``make_env(seeds=[seed])``.
        seeds: of the episodes.
        n_action_steps: actions of a chunk that are executed.
        settings: see `make_controller`.
    """
    recorded, by_controller = {}, {}
    for text in texts:
        controller = TOKEN_METHODS[parse_token_method(text).name].controller
        if controller not in by_controller:
            actor = ChunkExecutor(dense, n_action_steps, make_controller(text, settings))
            episodes = recorded_queries(dense, actor, make_env, seeds)
            by_controller[controller] = [*tqdm(episodes, total=len(seeds), unit="episode", desc="recording")]
        recorded[text] = by_controller[controller]
    return recorded


def token_settings(options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the settings of pruners and controllers from a benchmark's options, see `make_pruner`.

    `SpecPrune` is as ``calibrate_tokens`` chose it for the policy, where no other fields are written.

    Args:
        options: with ``policy``, its folder; ``calibrated``, whether to read ``specprune.json`` in it, if there is one;
            ``specprune``, fields of `SpecPruneOptions` that go before; ``controller``, see `ControllerOptions`; and
            ``n_action_steps``, of a chunk that are executed.

    Examples:
        >>> options = {"policy": "assets/vla", "calibrated": True, "specprune": {"keep_share": 0.9}, "controller": {}}
        >>> token_settings(options)["specprune"]["alpha"]
        0.17
    """
    path, changes = Path(options["policy"]) / "specprune.json", options["specprune"]
    if options["calibrated"] and path.is_file():
        budget = TokenBudget.from_pretrained(path)
        changes = {"alpha": budget.number, **budget.settings, **changes}
    controller = dict(options["controller"])
    if controller.get("motion") == "commanded":  # whose rule asks whether a chunk is used up
        controller.setdefault("chunk_steps", options["n_action_steps"])
    return {"specprune": dict(changes), "controller": controller}


def skipped_layers(dense: VLAPolicy, recorded: Recorded, count: int) -> list[int]:
    """Return the decoder layers that change their input least on recorded policy calls, see `redundant_layers`."""
    similarity = [replay(dense, queries, LayerSimilarity())[SIMILARITY] for queries in recorded]
    return redundant_layers(torch.cat(similarity), count)


def check_budgets(texts: Iterable[str], spec: VisualSpec, settings: Settings) -> None:
    """Refuse methods whose controller sets more tokens than the model has, before any episode is played.

    Args:
        texts: of methods; of those that match another's tokens the number is not known yet.
        spec: of the model.
        settings: see `make_pruner`.

    Raises:
        InputError: naming the method.
    """
    for text in texts:
        if parse_token_method(text).like is None and (pruner := make_pruner(text, settings=settings)):
            budgets = getattr(make_controller(text, settings), "budgets", ())
            for budget in budgets if isinstance(pruner, SpecPrune) else ():
                check_budget(f"methods: {text}: alpha * budget", pruner.options.alpha * budget, spec)
            pruner.bind(spec)


def filmed_methods(videos: Iterable[str], methods: Sequence[str]) -> dict[str, str]:
    """Return the methods to film: video -> method. A video is named like its method, or like the part before the @.

    Raises:
        InputError: if none or several of the methods are meant.

    >>> filmed_methods(["dense", "specprune"], ["dense", "specprune@0.17", "fastv@specprune@0.17"])
    {'dense': 'dense', 'specprune': 'specprune@0.17'}
    """
    filmed = {}
    for video in videos:
        meant = [name for name in methods if video in (name, parse_token_method(name).name)]
        if video not in meant and len(meant) != 1:
            raise InputError(f"videos: expected one of {', '.join(methods)}, got {video!r}")
        filmed[video] = video if video in meant else meant[0]
    return filmed


def matched_number(
    text: str,
    dense: VLAPolicy,
    recorded: Recorded,
    episodes: Mapping[str, Sequence[EpisodeResult]],
    settings: Settings,
) -> float | None:
    """Return a method's number: its own, or the share that keeps as many tokens as the method that it matches.

    Args:
        text: the method, see `torchrl_sparse.methods.vla`.
        dense: the dense policy.
        recorded: the method's policy calls, see `record_methods`.
        episodes: name -> episodes, those of the method that is matched among them.
        settings: see `make_pruner`.
    """
    written = parse_token_method(text)
    if written.like is None:
        return next(iter(written.rates), None)
    kept = tokens_kept(episodes[written.like]).kept_mean
    budgets = getattr(make_controller(text, settings), "budgets", (1.0,))
    fits = dense.network.config.visual_spec.per_camera / max(budgets)  # of an alpha, which multiplies them
    return matching_share(
        lambda share: make_pruner(text, number=share, settings=settings),
        dense,
        recorded,
        kept,
        most=min(1.0, fits),
    )


def matches_last(texts: Iterable[str]) -> list[str]:
    """Return methods in running order: those that match another one come last."""
    return sorted(texts, key=lambda text: parse_token_method(text).like is not None)
