"""Measure success against latency in a world that moves on.

The environment keeps moving while the policy computes.

    python recipes/realtime.py task=lift_moving policy=runs/lift_moving/policy methods=[dense,ddim10,bac] episodes=100

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Latency 0 is the ordinary evaluation.
``NAME_ahead`` shows the policy the state in which its answer will begin; ``demos`` is what the model of the state is fitted to.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.control.realtime_executor import delay_steps
from torchrl_sparse.control.roll_forward import StateModel
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.contract import policy_contract
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, evaluation_seeds, tuning_seeds
from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.envs.tasks import RobosuiteTask, find_robosuite_task
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods, time_methods
from torchrl_sparse.evaluation.benchmarks.late import evaluate_late
from torchrl_sparse.evaluation.benchmarks.rounds import episode_horizon
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.results.build import Terms
from torchrl_sparse.evaluation.results.realtime import RealtimeRun, build_realtime, format_realtime
from torchrl_sparse.evaluation.statistics.sequential import Design
from torchrl_sparse.methods.diffusion import check_method
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.calibration import calibrate_policy
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.state_model import fit_state_model


@recipe("realtime")
def main(config: DictConfig) -> None:
    out, task, planners = Path(config.out), find_robosuite_task(config.task), Path(config.planners)
    for name in config.methods:
        check_method(name, planners)
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    seen = policy_contract(task.name, policy).state_keys
    if seen != task.state_keys:  # from which the pose to hold is read
        raise ValueError(
            f"policy: expected one that observes {', '.join(task.state_keys)}, got one of {', '.join(seen)}"
        )
    model = state_model(config, task, policy)
    config.n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    make_env = diffusion_env(task.name, policy, config.horizon)
    first_observations = tuning_seeds(CALIBRATION_SEED, config.calibration_samples)
    calibration = cache(partial(calibrate_policy, policy, make_env, first_observations))
    methods = make_methods(
        config.methods, policy, num_updates=config.num_updates, planners=planners, calibration=calibration
    )
    seeds = evaluation_seeds(config.split, config.seed, config.episodes)
    queries = record_queries(ChunkExecutor(policy), make_env, seeds[:1])
    latency = time_methods(methods, queries, repeats=config.latency_repeats, threads=config.threads)

    horizon, margins = episode_horizon(make_env, seeds), (config.margin, config.time_margin)
    terms = Terms(Design(len(seeds)), horizon, task.early_cut, *margins)
    shared = {name: config[name] for name in ("out", "num_envs", "workers", "backend")}
    settings = {name: config[name] for name in ("task", "horizon", "n_action_steps")}
    shared |= {"model": model, "settings": settings, "policy_device": config.device}
    runs = {}
    with backend_runtime(config.backend, config.workers):  # one Ray for all runs
        for name, method in methods.items():
            delays = delay_steps(torch.tensor([latency[name].p50, *config.latencies]), CONTROL_FREQ)
            episodes = {
                steps: evaluate_late(
                    name, method, steps, make_env, seeds, control_freq=CONTROL_FREQ, **shared
                )
                for steps in delays.unique().tolist()
            }
            runs[name] = RealtimeRun(latency[name].p50, episodes)
    results = build_realtime(
        runs,
        task=task.name,
        split=config.split,
        seed=config.seed,
        control_freq=CONTROL_FREQ,
        n_action_steps=config.n_action_steps,
        machine=describe_machine(config.device, config.threads),
        terms=terms,
    )
    write_json(out / "realtime.json", results)
    plot_realtime(results, out / "realtime.png")
    print(f"\n{format_realtime(results)}\n\nfiles are in {out}")


def state_model(config: DictConfig, task: RobosuiteTask, policy: DiffusionPolicy) -> StateModel | None:
    """Fit what methods named ``_ahead`` roll the policy's state forward with; None if there are none."""
    if not any(MethodSpec.parse(name).ahead for name in config.methods):
        return None
    if config.demos is None:
        raise ValueError("demos: expected demonstrations to fit the _ahead methods' model to, got null")
    demos, steps = policy_demos(config.demos, task.name, policy), 3
    model, error = fit_state_model(demos, steps)
    print(
        f"{config.demos}: {steps} steps ahead the model of the state errs by {error:.2f} of what no model does"
    )
    return model


if __name__ == "__main__":
    main()
