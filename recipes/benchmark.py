"""Compare dense and accelerated: success, time, latency.

Methods are paired; it leaves a table, plots and videos.

    python recipes/benchmark.py task=lift methods=[dense,dense_noise,ddim10,bac] episodes=50 out=outputs/lift
    python recipes/benchmark.py task=lift methods=[dense,ddim10] split=test until=decided max_episodes=1300

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Nothing else is kept between runs.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.options import check_names
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.benchmarks.benchmark import BenchmarkOptions
from torchrl_sparse.evaluation.benchmarks.diffusion import DiffusionBenchmark, default_methods, make_methods
from torchrl_sparse.evaluation.results.short_table import print_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.methods.diffusion import check_method
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.calibration import lazy_calibration
from torchrl_sparse.training.diffusion.published import executed_steps


@recipe("benchmark")
def main(config: DictConfig) -> None:
    out, task, planners = Path(config.out), find_task(config.task), Path(config.planners)
    if config.methods is None:
        config.methods = default_methods(planners)
        print(f"methods: {', '.join(config.methods)}")
    check_names(config, partial(check_method, planners=planners))
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    config.n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    make_env = diffusion_env(task.name, policy, config.horizon)
    calibration = lazy_calibration(policy, make_env, config.calibration_samples)
    methods = make_methods(
        config.methods, policy, num_updates=config.num_updates, planners=planners, calibration=calibration
    )
    results = DiffusionBenchmark(BenchmarkOptions.of(config), methods, make_env, calibration).run()
    if config.logger == "wandb":
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print_results(results, config.table, out)


if __name__ == "__main__":
    main()
