"""Find how many visual tokens a VLA can do without.

A method then keeps the fewest within a tolerance of the dense policy.

    python recipes/calibrate_tokens.py task=lift_named policy=assets/vla tolerance=0.02
    python recipes/calibrate_tokens.py task=lift_named policy=assets/vla demos=data/lift_named_images.h5   # without rendering
    python recipes/calibrate_tokens.py task=lift_named policy=assets/vla measure=success tolerance=0.05
    python recipes/calibrate_tokens.py task=lift_named policy=assets/vla method=fastv   # a baseline, by the same rule

Writes ``out``, which `TokenBudget.from_pretrained` reads, and a figure beside it; prints the method as benchmark_vla takes it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.cli.vla import load_vla
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.data.for_policy import instructed_demos
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.envs.instructed import instructed_env
from torchrl_sparse.envs.seeds import tuning_seeds
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.tokens import plot_token_budgets
from torchrl_sparse.methods.token_budget import BudgetPoint, TokenBudget, fewest_tokens, numbered_pruner
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.training.vla.token_budget import (
    demonstrated_queries,
    measure_errors,
    measure_success,
    recorded_queries,
)
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations

Pruners = dict[float, TokenPruner]


@recipe("calibrate_tokens", out="file")
def main(config: DictConfig) -> None:
    measures = {"action_error": errors, "success": lost_episodes}
    if config.measure not in measures:
        raise InputError(f"measure: expected one of {', '.join(measures)}, got {config.measure!r}")
    tried = pruners(config)  # first, since what it refuses need not be recorded
    policy = load_vla(config, config.task).to(config.device)
    points = tuple(measures[config.measure](policy, tried, config))
    for point in points:
        print(f"{config.method}@{point.number:g}: {point.kept:.1f} visual tokens, loss {point.loss:.4g}")
    number = fewest_tokens(points, config.tolerance)
    settings = OmegaConf.to_container(config.options)
    budget = TokenBudget(config.method, number, config.measure, config.tolerance, points, settings)
    out = Path(config.out)
    budget.save_pretrained(out)
    plot_token_budgets([budget], out.with_suffix(".png"))
    print(f"{out}: {config.method}@{number:g}, {config.measure} within {config.tolerance:g} of dense")
    base = "" if config.base is None else f" base={config.base}"
    methods = f"methods=[dense,{config.method}@{number:g}]"
    print(f"next: torchrl-sparse benchmark_vla task={config.task} policy={config.policy}{base} {methods}")


def errors(policy: VLAPolicy, tried: Pruners, config: DictConfig) -> list[BudgetPoint]:
    """Measure the action error of each token budget on the same recorded policy calls."""
    if config.demos is not None:
        task = find_robosuite_task(config.task)
        poses = task.pose_slices(task.proprioception_keys)
        recorded = demonstrated_queries(policy, demonstrations(policy, config), config.n_action_steps, poses)
    else:
        recorded = recorded_queries(
            policy, executor(policy, config), environment(policy, config), seeds(config)
        )
    recorded = islice(recorded, config.episodes)
    episodes = [*tqdm(recorded, total=config.episodes, unit="episode", desc="recording")]
    with tqdm(total=len(episodes), unit="episode", desc="replaying") as bar:
        return measure_errors(policy, episodes, tried, config.n_action_steps, bar.update)


def lost_episodes(policy: VLAPolicy, tried: Pruners, config: DictConfig) -> list[BudgetPoint]:
    """Measure the success rate that each token budget loses to the dense policy on the same initial states."""
    make_actor, make = partial(executor, config=config), environment(policy, config)
    with tqdm(total=(1 + len(tried)) * config.episodes, unit="episode") as bar:
        return measure_success(policy, make_actor, make, seeds(config), tried, bar.update)


def pruners(config: DictConfig) -> Pruners:
    options = OmegaConf.to_container(config.options)
    return {number: numbered_pruner(config.method, number, options) for number in config.numbers}


def demonstrations(policy: VLAPolicy, config: DictConfig) -> InstructedDemonstrations:
    episodes = instructed_demos(config.demos, config.task, chosen_cameras(config.cameras), policy)
    return InstructedDemonstrations(episodes, read_instructions(config.demos))


def executor(policy: VLAPolicy, config: DictConfig) -> ChunkExecutor:
    options = OmegaConf.to_container(config.controller) if config.controller else None
    controller = None if options is None else ActionAwareController.from_options(**options)
    return ChunkExecutor(policy, config.n_action_steps, controller)


def seeds(config: DictConfig) -> range:
    return tuning_seeds(config.seed, config.episodes)


def environment(policy: VLAPolicy, config: DictConfig) -> Callable[..., EnvBase]:
    return instructed_env(config.task, policy, chosen_cameras(config.cameras), config.horizon)


if __name__ == "__main__":
    main()
