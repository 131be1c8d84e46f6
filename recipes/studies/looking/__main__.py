"""Measure on unseen rollouts whether a pruner's masks depend on the observation, and what its pruned blocks could reuse.

    python -m recipes.studies.looking task=lift policy=assets/lift pruner=assets/lift/sag

Without a pruner only the similarities of what could be reused are measured. With ``oracle.attempts=200`` masks for all policy
calls, for each phase of an episode and for each call are climbed to, which says what an
observation-conditioned pruner could gain, as far as a search finds it.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import torch
from omegaconf import DictConfig
from pydantic import Field
from tensordict import TensorDictBase
from tqdm import tqdm

from recipes.studies.looking.figures import plot_looking, plot_reuse_sources
from recipes.studies.looking.following import looking
from recipes.studies.looking.oracle import oracle
from recipes.studies.looking.reuse_sources import reuse_sources
from torchrl_sparse.blocks.sag.planner import SAGPruner
from torchrl_sparse.cli.options import Section, Whole, Word
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.published import published_shape

OPTIONS = {
    "draws": Annotated[int, Field(ge=3)],
    "looking.sampler": Word | None,
    "looking.pruner": Word | None,
    "played": Literal["pruned", "dense"],
    "oracle": Section,
    "attempts": Whole,
}
"""Options that no recipe of the library has -> type."""


@recipe("looking", options=OPTIONS)
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.oracle.attempts and not config.pruner:
        raise InputError(f"oracle.attempts: expected 0 without a pruner, got {config.oracle.attempts}")
    if config.sampler and config.pruner:
        raise InputError(
            f"sampler: expected null with a pruner, which brings its own, got {config.sampler!r}"
        )
    policy, task = make_policy(config), find_task(config.task).name
    n_action_steps = published_shape(task).n_action_steps
    seeds = tuning_seeds(DEVELOPMENT_SEED, config.episodes)
    played = policy if config.played == "pruned" else policy.with_plan(None)
    actor = ChunkExecutor(played, n_action_steps)
    queries = record_queries(actor, diffusion_env(task, policy), seeds)
    out, results = Path(config.out), {"task": task, "policy": policy.fingerprint}
    sources = reuse_sources(policy, queries[: config.samples])
    results["sources"] = asdict(sources)
    plot_reuse_sources(sources, out / f"reuse_sources_{task}.png", title=f"{task}, {policy.sampler.name}")
    if config.pruner:
        found = looking(policy, queries, n_action_steps=n_action_steps)
        results |= {"pruner": policy.plan.fingerprint, "looking": asdict(found)}
        plot_looking(found, out / f"looking_{task}.png", title=task)
        said = f"{found.varying:.1%} of the cells differ, {found.varying_in_episode:.1%} within an episode"
        print(f"{task}: rate {found.rate:.3f}, {said}")
        print("errors: " + ", ".join(f"{name} {error:.4f}" for name, error in found.error.items()))
        for name in ("own_minus_mean", "own_minus_others"):
            mean, low, high = getattr(found, name)
            print(f"{name}: {mean:+.4f} [{low:+.4f}, {high:+.4f}]")
    if config.oracle.attempts:
        results["oracle"] = climbed(policy, queries, n_action_steps, config)
    write_json(out / f"looking_{task}.json", results)
    for name in ("own", "type", "query"):
        alike = torch.tensor(results["sources"][name])[:, 1:].mean().item()
        print(f"reuse of {name}: cosine similarity {alike:.3f}")


def climbed(
    policy: DiffusionPolicy, queries: TensorDictBase, n_action_steps: int, config: DictConfig
) -> dict:
    """Return and print how much separate masks for each policy call could gain."""
    total = 3 * config.oracle.attempts
    with tqdm(desc=f"{'oracle':>14}", total=total, unit="attempt", mininterval=2) as bar:
        found = oracle(policy, queries, **config.oracle, n_action_steps=n_action_steps, on_attempt=bar.update)
    print("climbed to: " + ", ".join(f"{name} {error:.4f}" for name, error in found.error.items()))
    for name, (mean, low, high) in found.over_all.items():
        print(f"{name} minus all: {mean:+.4f} [{low:+.4f}, {high:+.4f}]")
    return asdict(found)


def make_policy(config: DictConfig) -> DiffusionPolicy:
    """Return the policy with the pruner and its sampler, or with the requested sampler."""
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    if config.pruner is None:
        return (
            policy
            if config.sampler is None
            else policy.with_plan(None, policy.sampler.variant_named(config.sampler))
        )
    pruner = SAGPruner.from_pretrained(config.pruner)
    made_for = pruner.made_for
    pruned = policy.with_plan(
        pruner, policy.sampler.variant_named(made_for.sampler, made_for.num_inference_steps)
    )
    return pruned.to(config.device)


if __name__ == "__main__":
    main()
