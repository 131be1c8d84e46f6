"""Benchmark a vision-language-action model with random weights: time of its parts, of pruning helpers, and what pruning saves.

    python recipes/profile_vla.py                                                      # reduced shape, one CPU thread
    python recipes/profile_vla.py shape=smollm2 "equal_to='specprune, alpha 1'"          # SmolLM2's, at equal tokens
    python recipes/profile_vla.py shape=published device=cuda dtype=bfloat16           # the published 7B shape

Writes OUT/vla_latency.json, a table and a chart. Times are medians, everything interleaved in one process.
"""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_sparse import keys
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.benchmarks.vla_latency import measure_vla
from torchrl_sparse.evaluation.figures.latency import plot_vla_times
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.latency.vla_cases import VLACase, make_policy
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.vla_report import format_vla_table, save_vla_results
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads
from torchrl_sparse.tokens import FastVPruner, FrameDifferencePruner, RandomPruner, SpecPrune
from torchrl_sparse.tokens.base import TokenPruner


@recipe("profile_vla")
def main(config: DictConfig) -> None:
    with num_threads(config.threads), torch.no_grad():
        policy = make_policy(config.shape, dtype=getattr(torch, config.dtype), device=config.device)
        pruners = make_pruners(config)
        if config.equal_to is not None:
            pruners |= equal_pruners(policy, pruners, config.equal_to)
        case = VLACase(policy, pruners)
        with progress("timing", "round", config.repeats) as show:
            results = measure_vla(
                case,
                name=config.shape,
                machine=describe_machine(config.device, config.threads),
                repeats=config.repeats,
                warmup=config.warmup,
                on_round=show,
            )
    out = Path(config.out)
    save_vla_results(results, out / "vla_latency.json")
    plot_vla_times(results, out / "vla_latency.png")
    print(f"\n{format_vla_table(results)}\n\nfiles are in {out}")


def make_pruners(config: DictConfig) -> dict[str, TokenPruner | None]:
    """Make SpecPrune at every alpha, the others at every share, and dense."""
    pruners: dict[str, TokenPruner | None] = {DENSE: None}
    pruners |= {f"specprune, alpha {alpha:g}": SpecPrune(alpha=alpha) for alpha in config.alphas}
    pruners |= {f"fastv, {share:.0%}": FastVPruner(share) for share in config.shares}
    pruners |= {f"random, {share:.0%}": RandomPruner(share) for share in config.shares}
    return pruners


def equal_pruners(
    policy: VLAPolicy, pruners: dict[str, TokenPruner | None], name: str
) -> dict[str, TokenPruner]:
    """Make FastV, frame difference and random that keep as many tokens in a layer, on average, as the pruner ``name``."""
    if name not in pruners:
        raise ValueError(f"equal_to: expected one of {', '.join(pruners)}, got {name!r}")
    share = VLACase(policy, {name: pruners[name]}).answer(name)[keys.KEPT].item()
    share /= policy.network.config.num_visual
    # the share of layers that see every token
    before = FastVPruner().layer / policy.network.config.llm.layers
    if share <= before:
        raise ValueError(
            f"equal_to: expected a method that keeps more than {before:.0%}, got {share:.0%} of {name}"
        )
    return {
        "fastv, as many": FastVPruner((share - before) / (1 - before)),
        "frame difference, as many": FrameDifferencePruner(share),
        "random, as many": RandomPruner(share),
    }


if __name__ == "__main__":
    main()
