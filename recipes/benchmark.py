"""Compare dense and accelerated: success, time, latency.

Methods are paired; it leaves a table, plots and videos.

    python recipes/benchmark.py task=lift methods=[dense,dense_noise,ddim10,bac] episodes=50 out=outputs/lift
    python recipes/benchmark.py task=lift methods=[dense,ddim10] split=test until=decided max_episodes=1300

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Nothing else is kept between runs.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.options import check_names
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, evaluation_seeds, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.benchmarks.diffusion import (
    default_methods,
    draw_methods,
    make_methods,
    measure_methods,
    settle_rates,
)
from torchrl_sparse.evaluation.benchmarks.film import film_masks
from torchrl_sparse.evaluation.benchmarks.rounds import episode_horizon, make_design, play_rounds
from torchrl_sparse.evaluation.benchmarks.summary import describe_policy
from torchrl_sparse.evaluation.figures.ways import plot_ways, told_ways
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.results.build import Terms, build_results
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.short_table import print_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.methods.diffusion import check_method, method_identity
from torchrl_sparse.methods.executor import make_executor
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.training.diffusion.calibration import calibrate_policy
from torchrl_sparse.training.diffusion.published import executed_steps


@recipe("benchmark")
def main(config: DictConfig) -> None:
    out, task, planners = Path(config.out), find_task(config.task), Path(config.planners)
    if config.methods is None:
        config.methods = default_methods(planners)
        print(f"methods: {', '.join(config.methods)}")
    check_names(config, partial(check_method, planners=planners))
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device).freeze()
    config.n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    make_env = diffusion_env(task.name, policy, config.horizon)
    first_observations = tuning_seeds(CALIBRATION_SEED, config.calibration_samples)
    calibration = cache(partial(calibrate_policy, policy, make_env, first_observations))
    methods = make_methods(
        config.methods, policy, num_updates=config.num_updates, planners=planners, calibration=calibration
    )
    actors = {name: make_executor(name, method, config.n_action_steps) for name, method in methods.items()}
    design = make_design(config.until, config.episodes, config.max_episodes)
    seeds = evaluation_seeds(config.split, config.seed, design.max_episodes)
    margins = config.margin, config.time_margin
    terms = Terms(design, episode_horizon(make_env, seeds), task.early_cut, *margins, task.by_degrees)
    settings = {"task": config.task, "horizon": config.horizon}

    def play(name: str, count: int) -> list[EpisodeResult]:
        return evaluate(
            name,
            actors[name],
            make_env,
            seeds[:count],
            log=episode_log(out, name, config.dense_log),
            identity=method_identity(name, methods[name])
            | settings
            | {"n_action_steps": actors[name].n_action_steps},
            num_envs=config.num_envs,
            policy_device=config.device,
            workers=config.workers,
            backend=config.backend,
        )

    with backend_runtime(config.backend, config.workers):  # one Ray for all methods
        episodes = play_rounds(actors, play, terms)
    settle_rates(methods, episodes)
    queries = record_queries(actors["dense"], make_env, seeds[: config.probe_episodes])
    runs = measure_methods(methods, episodes, queries, repeats=config.latency_repeats, threads=config.threads)
    results = build_results(
        runs,
        task=task.name,
        split=config.split,
        seed=config.seed,
        terms=terms,
        machine=describe_machine(config.device, config.threads),
        policy=describe_policy(policy, config.n_action_steps),
        pairs=config.pairs,
    )
    save_results(results, out / "results.json")
    draw_methods(results, methods, queries, calibration(), out)
    if ways := told_ways(episodes):
        plot_ways(ways, out / "ways.png", title=f"{task.name}, {config.split} seeds: ways that were taken")
    if left_out := [name for name in config.videos if name not in actors]:
        print(f"no video of {', '.join(left_out)}: not among the methods")
    try:
        for name in filter(actors.__contains__, config.videos):
            film_masks(name, actors[name], make_env, seeds[0], out, config.threads)
    except RuntimeError as error:  # no GL library
        print(f"no video: {error}")
    if config.logger == "wandb":
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print_results(results, config.table, out)


if __name__ == "__main__":
    main()
