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
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.envs.instructed import find_instructed_task, instructed_env
from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.evaluation.benchmarks.film import film_tokens
from torchrl_sparse.evaluation.benchmarks.rounds import episode_horizon, make_design, play_rounds
from torchrl_sparse.evaluation.benchmarks.summary import describe_policy
from torchrl_sparse.evaluation.benchmarks.vla import (
    check_budgets,
    filmed_methods,
    matched_number,
    matches_last,
    record_methods,
    skipped_layers,
    token_settings,
)
from torchrl_sparse.evaluation.benchmarks.vla_measure import draw_methods, measure_methods
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.results.build import Terms, build_results
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.short_table import print_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.evaluation.rollouts.vla_methods import method_identity
from torchrl_sparse.methods.vla import check_matches, make_controller, make_pruner, parse_token_method
from torchrl_sparse.runtime.backends import backend_runtime


@recipe("benchmark_vla")
def main(config: DictConfig) -> None:
    out, methods = Path(config.out), [*dict.fromkeys(["dense", *config.methods])]
    check_names(config, parse_token_method)
    check_matches(methods)
    filmed = filmed_methods(config.videos, methods)
    options = token_settings(OmegaConf.to_container(config, resolve=True))
    task = find_instructed_task(config.task)  # before a policy is loaded that may be large
    dense = load_vla(config, config.task).to(config.device)
    check_budgets(methods, dense.network.config.visual_spec, options)
    make_env = instructed_env(config.task, dense, chosen_cameras(config.cameras), config.horizon)
    design = make_design(config.until, config.episodes, config.max_episodes)
    seeds = evaluation_seeds(config.split, config.seed, design.max_episodes)
    terms = Terms(design, episode_horizon(make_env, seeds), task.early_cut, config.margin, config.time_margin)
    settings = {"task": config.task, "horizon": config.horizon, "n_action_steps": config.n_action_steps}
    probed = {"seeds": seeds[: config.probe_episodes], "n_action_steps": config.n_action_steps}
    recorded = record_methods(methods, dense, make_env, **probed, settings=options)
    if any(parse_token_method(name).name == "efficientvla_layers" for name in methods):
        skipped = skipped_layers(dense, recorded["dense"], config.skipped_layers)
        options["efficientvla"] = {"skipped": skipped}

    actors, numbers, played = {}, {}, {}

    def play(name: str, count: int) -> list[EpisodeResult]:
        if name not in actors:  # what it matches has been played
            numbers[name] = matched_number(name, dense, recorded[name], played, options)
            policy = dense.with_pruner(make_pruner(name, number=numbers[name], settings=options))
            actors[name] = ChunkExecutor(policy, config.n_action_steps, make_controller(name, options))
        played[name] = evaluate(
            name,
            actors[name],
            make_env,
            seeds[:count],
            log=episode_log(out, name, config.dense_log),
            identity=method_identity(name, numbers[name], dense, options) | settings,
            num_envs=config.num_envs,
            workers=config.workers,
            backend=config.backend,
            policy_device=config.device,
        )
        return played[name]

    with backend_runtime(config.backend, config.workers):  # one Ray for all methods
        episodes = play_rounds(matches_last(methods), play, terms)
    policies = {name: actors[name].policy for name in methods}  # in the order asked for

    timing = {"repeats": config.latency_repeats, "threads": config.threads, "device": config.device}
    results = build_results(
        measure_methods(policies, recorded, episodes, **timing),
        task=config.task,
        split=config.split,
        seed=config.seed,
        terms=terms,
        machine=describe_machine(config.device, config.threads),
        policy=describe_policy(dense, config.n_action_steps),
        pairs=config.pairs,
        settings={**options, "numbers": numbers, "probe_episodes": config.probe_episodes},
    )
    save_results(results, out / "results.json")
    draw_methods(results, policies, recorded, out)
    for video, name in filmed.items():
        film_tokens(video, actors[name], make_env, seeds[0], out, config.threads)
    if config.logger == "wandb":
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print_results(results, config.table, out)


if __name__ == "__main__":
    main()
