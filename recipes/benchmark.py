"""Benchmarks a policy: dense against accelerated, paired, with a table, plots and videos.

    python recipes/benchmark.py task=lift methods=[dense,ddim10,bac] episodes=50 seed=0 out=outputs/lift

Kill it and run it again to go on: finished episodes are read from OUT/episodes. Nothing else is kept between runs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import hydra
import numpy as np
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer, record_queries
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, EVALUATION_SEED
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.figures.masks import mask_panel, plot_mask_statistics, plot_mask_strip
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.plots import (
    plot_error_surge,
    plot_schedule,
    plot_similarity,
)
from torchrl_sparse.evaluation.figures.video import Caption, write_video
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.latency.queries import time_planning, time_queries
from torchrl_sparse.evaluation.results.report import (
    MethodRun,
    build_results,
    format_pairs,
    format_table,
)
from torchrl_sparse.evaluation.results.schema import PolicyShape, Results, save_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.evaluation.statistics.fidelity import action_error, block_errors
from torchrl_sparse.methods.diffusion import (
    MethodName,
    check_method,
    make_controller,
    make_method,
    method_identity,
)
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.training.diffusion.calibration import calibrate_policy
from torchrl_sparse.training.diffusion.published import published_shape

SURGE_METHODS = ("uniform", "bac_blockwise", "bac")


@hydra.main(version_base=None, config_path=".", config_name="benchmark")
def main(config: DictConfig) -> None:
    out, task = Path(config.out), find_task(config.task)
    if config.n_action_steps is None:
        config.n_action_steps = published_shape(task.name).n_action_steps
    for name in config.methods:
        check_method(name, Path(config.planners))
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine)
    environment = diffusion_env(task.name, policy, config.horizon)

    @cache
    def calibration():
        seeds = range(CALIBRATION_SEED, CALIBRATION_SEED + config.calibration_samples)
        return calibrate_policy(policy, environment, seeds)

    names = dict.fromkeys(["dense", *config.methods])  # dense is what all others are compared with
    methods = {
        name: make_method(
            name,
            policy,
            num_updates=config.num_updates,
            planners=Path(config.planners),
            calibration=calibration,
        )
        for name in names
    }
    first = EVALUATION_SEED + config.seed
    seeds = range(first, first + config.episodes)

    with backend_runtime(config.backend, config.workers):  # one Ray for all methods
        episodes = {
            name: evaluate(name, method, environment, seeds, config) for name, method in methods.items()
        }
    settle_rates(methods, episodes)
    queries = record_queries(executor("dense", policy, config), environment, seeds[: config.probe_episodes])
    with tqdm(total=config.latency_repeats, unit="round", desc=f"{'latency':>14}") as bar:
        latency = time_queries(
            methods,
            queries,
            repeats=config.latency_repeats,
            threads=config.threads,
            on_round=lambda done, total: bar.update(done - bar.n),
        )
    adaptive = {name: method for name, method in methods.items() if not method.plan.is_static}
    planning = time_planning(adaptive, queries, threads=config.threads)
    errors = {name: error_to_dense(method, queries) for name, method in methods.items()}

    results = build_results(
        {
            name: MethodRun(episodes[name], latency[name], errors[name], planning.get(name))
            for name in methods
        },
        task=task.name,
        seed=config.seed,
        machine=describe_machine(threads=config.threads),
        policy=describe(policy, config),
        margin=config.margin,
    )
    save_results(results, out / "results.json")
    draw(results, methods, calibration(), queries, out)
    film(methods, environment, seeds[0], config)
    if config.wandb:
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print(f"\n{format_table(results)}")
    if config.pairs:
        print(f"\n{format_pairs(episodes, config.pairs, config.margin)}")
    print(f"\n{config.episodes} paired episodes per method; files are in {out}")


def executor(name: str, policy: DiffusionPolicy, config: DictConfig) -> ChunkExecutor:
    return ChunkExecutor(policy, n_action_steps=config.n_action_steps, controller=make_controller(name))


def evaluate(
    name: str, policy: DiffusionPolicy, environment: Callable[..., EnvBase], seeds: range, config: DictConfig
) -> list[EpisodeResult]:
    """Closed-loop episodes of one method, read from its log as far as they are there."""
    identity = {
        "task": config.task,
        "horizon": config.horizon,
        **method_identity(name, policy),
        "n_action_steps": config.n_action_steps,
    }
    log = Path(config.out) / "episodes" / f"{name}.jsonl"
    if name == "dense" and config.dense_log is not None:
        log = Path(config.dense_log)
    with tqdm(total=len(seeds), unit="episode", desc=f"{name:>14}") as bar:

        def show(_: EpisodeResult, done: int, total: int) -> None:
            bar.update(done - bar.n)

        return rollout_episodes(
            executor(name, policy, config),
            environment,
            seeds,
            num_envs=config.num_envs,
            workers=config.workers,
            backend=config.backend,
            results_file=log,
            identity=identity,
            on_episode=show,
        )


def settle_rates(methods: dict[str, DiffusionPolicy], episodes: dict[str, list[EpisodeResult]]) -> None:
    """Methods whose rate moves are timed at the mean rate of their episodes."""
    for name, method in methods.items():
        rates = MethodName.parse(name).rates
        if len(rates) == 2:
            method.plan.rate = min(max(totals(episodes[name]).prune_rate, min(rates)), max(rates))


def error_to_dense(method: DiffusionPolicy, queries: TensorDictBase) -> tuple[float, float]:
    """Mean and maximum error of normalised actions to the dense answers."""
    normalize = method.normalizer.normalize_action
    return action_error(normalize(answer(method, queries)[keys.CHUNK]), normalize(queries[keys.CHUNK]))


def describe(policy: DiffusionPolicy, config: DictConfig) -> PolicyShape:
    return PolicyShape(
        params=sum(parameter.numel() for parameter in policy.network.parameters()),
        num_inference_steps=policy.num_inference_steps,
        horizon=policy.horizon,
        n_obs_steps=policy.n_obs_steps,
        n_action_steps=config.n_action_steps,
    )


def draw(results: Results, methods: dict[str, DiffusionPolicy], calibration, queries, out: Path) -> None:
    plot_pareto(results, out / "pareto.png")
    plot_similarity(calibration.similarity.numpy(), out / "similarity.png")
    masks = {name: answer(method, queries[:1])[keys.PRUNE_MASK][0] for name, method in methods.items()}
    for name, mask in masks.items():
        ratio = results.methods[name].flops.ratio_to_dense
        plot_schedule(mask.numpy(), out / f"schedule_{name}.png", name=name, flops_ratio=ratio)
    for name, method in methods.items():
        if not method.plan.is_static:
            draw_masks(name, method, queries, out)
    surging = {name: masks[name] for name in SURGE_METHODS if name in masks}
    if surging:
        dense = methods["dense"]
        noise = dense.sample_noise(queries[keys.SEED].squeeze(-1))
        errors = block_errors(dense.network, dense.sampler, noise, queries[keys.COND], surging)
        plot_error_surge(
            {name: error.numpy() for name, error in errors.items()},
            {name: mask.numpy() for name, mask in surging.items()},
            out / "error_surge.png",
        )


def draw_masks(name: str, method: DiffusionPolicy, queries: TensorDictBase, out: Path) -> None:
    """How the masks change along an episode, and over all queries."""
    masks = answer(method, queries)[keys.PRUNE_MASK].numpy()
    plot_mask_statistics(masks, out / f"masks_{name}.png", name=name)
    step = queries[keys.EPISODE_STEP].flatten()
    first_episode = (queries[keys.EPISODE_SEED] == queries[keys.EPISODE_SEED][0]).flatten()
    steps_per_query = int(step[1] - step[0]) if first_episode.sum() > 1 else 1
    strip = masks[first_episode.numpy()]
    plot_mask_strip(strip, out / f"strip_{name}.png", name=name, steps_per_query=steps_per_query)


def film(
    methods: dict[str, DiffusionPolicy], environment: Callable[..., EnvBase], seed: int, config: DictConfig
) -> None:
    """A video of one episode per method; without a GL library, a line that says what to install."""
    for name in config.videos:
        if name not in methods:
            continue
        env = environment(seeds=[seed])
        try:
            adaptive = not methods[name].plan.is_static
            frames, captions = follow(name, executor(name, methods[name], config), env, adaptive)
        except RuntimeError as error:
            print(f"no video: {error}")
            return
        finally:
            env.close()
        write_video(frames, Path(config.out) / f"rollout_{name}.mp4", captions=captions)


def follow(name: str, actor: ChunkExecutor, env: EnvBase, show_masks: bool) -> tuple[list, list[Caption]]:
    """Frames of one episode, the last one after its last step, and what to write under them.

    With ``show_masks``, the mask of the latest query stands beside the camera's view.
    """
    frames, captions = [], []

    def photograph(env: EnvBase, step: TensorDictBase) -> None:
        frame = env.base_env.render("agentview", 320, 320)
        if show_masks:
            frame = np.hstack([frame, mask_panel(step[keys.PRUNE_MASK].numpy(), height=320)])
        frames.append(frame)

    def watch(env: EnvBase, step: TensorDictBase) -> None:
        photograph(env, step)
        queried = bool(step[keys.QUERIED])
        latency = float(step[keys.LATENCY]) if queried else captions[-1].latency
        captions.append(Caption(name, len(captions), queried, latency, bool(step[keys.SUCCESS])))

    env.base_env.reset()
    env.base_env.render("agentview", 320, 320)  # fails here, before any query, where there is no GL library
    steps = env.rollout(env.base_env.horizon, actor, callback=watch)
    photograph(env, steps[-1])
    solved = bool(steps["next", keys.SUCCESS][-1])
    captions.append(Caption(name, len(captions), False, captions[-1].latency, solved))
    return frames, captions


if __name__ == "__main__":
    main()
