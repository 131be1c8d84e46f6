"""Success against latency: the environment keeps moving while the policy computes.

    python recipes/realtime.py task=lift_moving policy=runs/lift_moving/policy methods=[dense,ddim10,bac] episodes=100

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Latency 0 is the ordinary evaluation.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.control.realtime_executor import HoldPose, RealtimeExecutor, delay_steps
from torchrl_sparse.envs.for_policy import diffusion_env, observed_keys
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, evaluation_seeds, tuning_seeds
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.latency.queries import time_queries
from torchrl_sparse.evaluation.results.realtime import (
    RealtimeRun,
    build_realtime,
    format_realtime,
    save_realtime,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.methods.diffusion import check_method, method_identity
from torchrl_sparse.methods.executor import executed_every, execution_options
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.training.diffusion.calibration import calibrate_policy
from torchrl_sparse.training.diffusion.published import executed_steps


@recipe("realtime")
def main(config: DictConfig) -> None:
    out, task, planners = Path(config.out), find_robosuite_task(config.task), Path(config.planners)
    for name in config.methods:
        check_method(name, planners)
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    if (seen := observed_keys(task.name, policy)) != task.state_keys:  # from which the pose to hold is read
        raise ValueError(
            f"policy: expected one that observes {', '.join(task.state_keys)}, got one of {', '.join(seen)}"
        )
    config.n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    make_env = diffusion_env(task.name, policy, config.horizon)
    first_observations = tuning_seeds(CALIBRATION_SEED, config.calibration_samples)
    calibration = cache(partial(calibrate_policy, policy, make_env, first_observations))
    methods = make_methods(
        config.methods, policy, num_updates=config.num_updates, planners=planners, calibration=calibration
    )
    seeds = evaluation_seeds(config.split, config.seed, config.episodes)
    queries = record_queries(ChunkExecutor(policy), make_env, seeds[:1])
    samples = {name: execution_options(name)["num_samples"] for name in methods}
    latency = time_queries(
        methods, queries, repeats=config.latency_repeats, threads=config.threads, samples=samples
    )

    runs = {}
    with backend_runtime(config.backend, config.workers):  # one Ray for all runs
        for name, method in methods.items():
            delays = delay_steps(torch.tensor([latency[name].p50, *config.latencies]), config.control_freq)
            episodes = {
                steps: evaluate_delayed(name, method, steps, make_env, seeds, config)
                for steps in delays.unique().tolist()
            }
            runs[name] = RealtimeRun(latency[name].p50, episodes)
    results = build_realtime(
        runs,
        task=task.name,
        seed=config.seed,
        control_freq=config.control_freq,
        n_action_steps=config.n_action_steps,
        machine=describe_machine(config.device, config.threads),
        margin=config.margin,
    )
    save_realtime(results, out / "realtime.json")
    plot_realtime(results, out / "realtime.png")
    print(f"\n{format_realtime(results)}\n\nfiles are in {out}")


def evaluate_delayed(
    name: str, policy: DiffusionPolicy, steps: int, make_env, seeds: range, config: DictConfig
) -> list[EpisodeResult]:
    """Run the episodes of one method whose answers come ``steps`` late."""
    hold = HoldPose(find_robosuite_task(config.task).pose_slices)
    actor = RealtimeExecutor(
        policy,
        hold,
        executed_every(name, policy, config.n_action_steps),
        latency=steps / config.control_freq,
        control_freq=config.control_freq,
        **execution_options(name),
    )
    settings = {"task": config.task, "horizon": config.horizon, "n_action_steps": actor.n_action_steps}
    return evaluate(
        f"{name} +{steps}",
        actor,
        make_env,
        seeds,
        log=episode_log(config.out, f"{name}_delay{steps}"),
        identity={**method_identity(name, policy), **settings, "delay_steps": steps},
        num_envs=config.num_envs,
        policy_device=config.device,
        workers=config.workers,
        backend=config.backend,
    )


if __name__ == "__main__":
    main()
