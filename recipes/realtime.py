"""Success against latency: the environment keeps moving while the policy computes.

    python recipes/realtime.py task=lift_moving policy=runs/lift_moving/policy methods=[dense,ddim10,bac] episodes=100

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Latency 0 is the ordinary evaluation.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.control.realtime_executor import HoldPose, RealtimeExecutor, delay_steps
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, EVALUATION_SEED
from torchrl_sparse.envs.tasks import find_robosuite_task
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
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.methods.diffusion import check_method, make_method, method_identity
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.training.diffusion.calibration import calibrate_policy


@hydra.main(version_base=None, config_path=".", config_name="realtime")
def main(config: DictConfig) -> None:
    out, task = Path(config.out), find_robosuite_task(config.task)
    for name in config.methods:
        check_method(name, Path(config.planners))
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine)
    environment = diffusion_env(task.name, policy, config.horizon)
    first = EVALUATION_SEED + config.seed
    seeds = range(first, first + config.episodes)

    @cache
    def calibration():
        samples = range(CALIBRATION_SEED, CALIBRATION_SEED + config.calibration_samples)
        return calibrate_policy(policy, environment, samples)

    make = partial(
        make_method,
        policy=policy,
        num_updates=config.num_updates,
        planners=Path(config.planners),
        calibration=calibration,
    )
    methods = {name: make(name) for name in dict.fromkeys(["dense", *config.methods])}
    queries = record_queries(ChunkExecutor(policy), environment, seeds[:1])
    latency = time_queries(methods, queries, repeats=config.latency_repeats, threads=config.threads)

    own = {name: delay(latency[name].p50, config) for name in methods}
    common = {delay(seconds, config) for seconds in config.latencies}
    runs = {}
    with backend_runtime(config.backend, config.workers):  # one Ray for all runs
        for name, method in methods.items():
            episodes = {
                steps: evaluate(name, method, steps, environment, seeds, config)
                for steps in sorted({*common, own[name]})
            }
            runs[name] = RealtimeRun(latency[name].p50, episodes)
    results = build_realtime(
        runs,
        task=task.name,
        seed=config.seed,
        control_freq=config.control_freq,
        n_action_steps=config.n_action_steps,
        machine=describe_machine(threads=config.threads),
        margin=config.margin,
    )
    save_realtime(results, out / "realtime.json")
    plot_realtime(results, out / "realtime.png")
    print(f"\n{format_realtime(results)}\n\nfiles are in {out}")


def delay(seconds: float, config: DictConfig) -> int:
    return int(delay_steps(torch.tensor(seconds), config.control_freq))


def evaluate(
    name: str, policy: DiffusionPolicy, steps: int, environment, seeds: range, config: DictConfig
) -> list[EpisodeResult]:
    """Episodes of one method whose answers come ``steps`` late, read from their log as far as they are there."""
    actor = RealtimeExecutor(
        policy,
        HoldPose(find_robosuite_task(config.task)),
        config.n_action_steps,
        latency=steps / config.control_freq,
        control_freq=config.control_freq,
    )
    identity = {
        "task": config.task,
        "horizon": config.horizon,
        **method_identity(name, policy),
        "n_action_steps": config.n_action_steps,
        "delay_steps": steps,
    }
    with tqdm(total=len(seeds), unit="episode", desc=f"{name} +{steps}".rjust(14)) as bar:
        return rollout_episodes(
            actor,
            environment,
            seeds,
            num_envs=config.num_envs,
            workers=config.workers,
            backend=config.backend,
            results_file=Path(config.out) / "episodes" / f"{name}_delay{steps}.jsonl",
            identity=identity,
            on_episode=lambda _, done, total: bar.update(done - bar.n),
        )


if __name__ == "__main__":
    main()
