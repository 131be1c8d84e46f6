"""Search which blocks of a few stochastic steps to compute, and at which timesteps, at the cost of fewer full steps.

    python -m recipes.studies.search_schedule task=can demos=data/can.h5 budget=2 lengths=[3,4,5]

Training-free: demonstrations decide, some of which the search does not see. The result is a schedule, ``searched.json``,
and the method ``searched`` of a benchmark. A search that was killed goes on from ``tried.json``.
"""

from __future__ import annotations

from dataclasses import asdict
from math import ceil
from pathlib import Path
from typing import Annotated, Literal

import torch
from omegaconf import DictConfig, OmegaConf
from pydantic import Field
from tqdm import tqdm

from recipes.studies.search_schedule.evolution import Evolution
from recipes.studies.search_schedule.schedules import (
    Judge,
    chain_schedule,
    compare,
    judged_rows,
    rivals,
    search_schedule,
)
from torchrl_sparse.cli.options import Between, Count, Positive, Section
from torchrl_sparse.cli.recipe import benchmark_command, recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.pruner.loss import block_weights

NAME = "searched"


OPTIONS = {
    "draws": Annotated[int, Field(ge=3)],
    "held_out": Between,
    "lengths": list[Count],
    "budget": Positive,
    "cost": Literal["seconds", "flops"],
    "fitness": Literal["energy_score", "error"],
    "search": Section,
    "population": Count,
    "generations": Count,
    "random_masks": Count,
}
"""Options that no recipe of the library has -> type."""


@recipe("search_schedule", options=OPTIONS)
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    judge, unseen = make_judges(policy, config)
    out, fitness, options = Path(config.out), config.fitness, Evolution(**config.search)
    with progress("chains", "chain") as show:
        space, tried = search_schedule(
            judge,
            lambda: block_weights(policy, config.cost),
            out / "tried.json",
            budget=config.budget,
            lengths=tuple(config.lengths),
            fitness=fitness,
            options=options,
            made_for=made_for(policy, config),
            on_chain=show,
        )
    best = next(iter(tried))
    with tqdm(desc=f"{'comparison':>14}", unit="chain", mininterval=2) as bar:
        chains = rivals(
            judge,
            space,
            best,
            fitness=fitness,
            random_masks=config.random_masks,
            seed=options.seed,
            on_chain=bar.update,
        )
        judged = compare(unseen, space, chains, on_chain=bar.update)
    settings = OmegaConf.to_container(config, resolve=True)
    settings |= {"tried": len(tried), "held_out": {name: asdict(one) for name, one in judged.items()}}
    made = chain_schedule(policy, best, config.reuse, settings)
    made.save_pretrained(out / f"{NAME}.json")
    print(f"{out / NAME}.json: {made.sampler}, {space.cost(best):.2f} steps, {len(tried)} chains tried")
    print(f"\n{markdown_table(judged_rows(judged))}\n")
    print(benchmark_command(config.task, config.policy, out, [NAME]))


def make_judges(policy: DiffusionPolicy, config: DictConfig) -> tuple[Judge, Judge]:
    """Return two judges: one on the demonstrations used by the search, one on the last ones, which are held out."""
    task = find_task(config.task)
    demos = policy_demos(config.demos, task.name, policy)
    if len(demos) < 2:
        raise InputError(f"demos: expected at least 2, of which some are held out, got {len(demos)}")
    split = len(demos) - min(ceil(config.held_out * len(demos)), len(demos) - 1)
    n_action_steps = executed_steps(task.name, policy.source)
    options = {"draws": config.draws, "n_action_steps": n_action_steps, "reuse": config.reuse}

    def make(first: int, last: int, seed: int) -> Judge:
        asked = {**config.targets, "source": "data", "n_action_steps": n_action_steps}
        return Judge(policy, make_targets(policy, demos.between(first, last), **asked), **options, seed=seed)

    return make(0, split, config.targets.seed), make(split, len(demos), config.targets.seed + 1)


def made_for(policy: DiffusionPolicy, config: DictConfig) -> dict:
    """Return the options that a search depends on: all except its end, its folder and its machine."""
    settings = OmegaConf.to_container(config, resolve=True)
    kept = {name: settings[name] for name in ("task", "demos", "targets", "draws", "held_out")}
    kept |= {name: settings[name] for name in ("lengths", "budget", "cost", "reuse", "fitness")}
    search = {name: settings["search"][name] for name in ("population", "seed")}
    return {"policy": policy.fingerprint, **kept, "search": search}


if __name__ == "__main__":
    main()
