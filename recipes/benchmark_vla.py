"""Compare a VLA dense and with pruned visual tokens.

Methods are paired; it leaves a table, plots and videos.

    python recipes/benchmark_vla.py policy=runs/vla_lift_named/policy methods=[dense,specprune,fastv@specprune]
    python recipes/benchmark_vla.py policy=FOLDER_OF_OPENVLA_OFT task=libero_spatial split=test episodes=500 num_envs=10

Needs a GL library, and for LIBERO the extra libero. Kill it and run it again to go on: finished episodes are in OUT/episodes.
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.options import check_names
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.cli.vla import load_vla
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.envs.instructed import find_instructed_task, instructed_env
from torchrl_sparse.evaluation.benchmarks.benchmark import BenchmarkOptions
from torchrl_sparse.evaluation.benchmarks.vla import filmed_methods, token_settings
from torchrl_sparse.evaluation.benchmarks.vla_benchmark import VLABenchmark
from torchrl_sparse.evaluation.results.short_table import print_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.methods.vla import check_matches, parse_token_method


@recipe("benchmark_vla")
def main(config: DictConfig) -> None:
    out, methods = Path(config.out), [*dict.fromkeys(["dense", *config.methods])]
    check_names(config, parse_token_method)
    check_matches(methods)
    filmed_methods(
        config.videos, methods
    )  # what is wrong is said before a policy is loaded that may be large
    pruning = token_settings(OmegaConf.to_container(config, resolve=True))
    task = find_instructed_task(config.task)
    dense = load_vla(config, config.task).to(config.device)
    make_env = instructed_env(config.task, dense, chosen_cameras(config.cameras), config.horizon)
    benchmark = VLABenchmark(
        BenchmarkOptions.of(config),
        task,
        dense,
        methods,
        make_env,
        pruning=pruning,
        skipped=config.skipped_layers,
    )
    results = benchmark.run()
    if config.logger == "wandb":
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print_results(results, config.table, out)


if __name__ == "__main__":
    main()
