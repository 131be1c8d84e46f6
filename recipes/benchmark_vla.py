"""Benchmarks a vision-language-action policy: dense against pruned visual tokens, paired, with a table, plots and videos.

    python recipes/benchmark_vla.py policy=runs/vla_lift_named/policy methods=[dense,specprune,fastv@specprune]

Needs a GL library. Kill it and run it again to go on: finished episodes are read from OUT/episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.envs.for_policy import instructed_env
from torchrl_sparse.envs.seeds import EVALUATION_SEED
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.tokens import (
    draw_tokens,
    plot_control,
    plot_token_strip,
    plot_tokens_per_layer,
)
from torchrl_sparse.evaluation.figures.video import Caption, write_video
from torchrl_sparse.evaluation.latency.measure import describe_machine, measure_latency
from torchrl_sparse.evaluation.results.report import (
    MethodRun,
    build_results,
    format_pairs,
    format_table,
)
from torchrl_sparse.evaluation.results.schema import PolicyShape, save_results
from torchrl_sparse.evaluation.results.tracking import log_benchmark
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, token_totals
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.evaluation.rollouts.vla_methods import (
    matching_share,
    method_identity,
    mid_episode_query,
    seen_images,
)
from torchrl_sparse.evaluation.statistics.fidelity import action_error
from torchrl_sparse.methods.vla import TokenMethodName, check_matches, make_controller, make_pruner
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.backends import backend_runtime
from torchrl_sparse.training.vla.token_budget import recorded_queries, replay

_SHOWN = 6  # queries of a strip
_ZOOM = 2


@hydra.main(version_base=None, config_path=".", config_name="benchmark_vla")
def main(config: DictConfig) -> None:
    out = Path(config.out)
    methods = [*dict.fromkeys(["dense", *config.methods])]
    check_matches(methods)
    dense = VLAPolicy.from_pretrained(config.policy).to(config.device)
    environment = instructed_env(config.task, dense, chosen_cameras(config.cameras), config.horizon)
    seeds = range(EVALUATION_SEED + config.seed, EVALUATION_SEED + config.seed + config.episodes)
    actor = executor("dense", dense, config)
    recorded = recorded_queries(dense, actor, environment, seeds[: config.probe_episodes])
    recorded = [*tqdm(recorded, total=len(seeds[: config.probe_episodes]), unit="episode", desc="recording")]

    policies, episodes = {}, {}
    settings = {"specprune": OmegaConf.to_container(config.specprune)}
    with backend_runtime(config.backend, config.workers):  # one Ray for all methods
        written = {text: TokenMethodName.parse(text) for text in methods}
        for text in sorted(methods, key=lambda text: written[text].like is not None):
            make, number = partial(make_pruner, text, settings=settings), written[text].number
            if (like := written[text].like) is not None:
                kept = token_totals(episodes[like]).mean
                number = matching_share(lambda share, make=make: make(number=share), dense, recorded, kept)
            policies[text] = dense.with_pruner(make(number=number))
            identity = method_identity(text, number, dense, settings)
            episodes[text] = evaluate(text, policies[text], environment, seeds, identity, config)
    policies = {text: policies[text] for text in methods}  # in the order asked for

    latency = measure_latency(
        {name: partial(answer, p, mid_episode_query(p, recorded[0])) for name, p in policies.items()},
        repeats=config.latency_repeats,
        threads=config.threads,
        device=config.device,
    )
    answers = {name: replay_all(policy, recorded) for name, policy in policies.items()}
    errors = {name: error_to_dense(dense, answers[name], answers["dense"]) for name in policies}
    results = build_results(
        {name: MethodRun(episodes[name], latency[name], errors[name]) for name in policies},
        task=config.task,
        seed=config.seed,
        machine=describe_machine(config.device, config.threads),
        policy=describe(dense, config),
        margin=config.margin,
    )
    save_results(results, out / "results.json")
    plot_pareto(results, out / "pareto.png")
    depth = {name: answer[keys.TOKEN_DEPTH].numpy(force=True) for name, answer in answers.items()}
    plot_tokens_per_layer(depth, dense.network.config.llm.layers, out / "tokens_per_layer.png")
    for name in config.videos:
        if name in policies:
            film(name, policies[name], environment(seeds=seeds[:1]), config)
    if config.wandb:
        log_benchmark(results, out, OmegaConf.to_container(config, resolve=True))
    print(f"\n{format_table(results)}")
    if config.pairs:
        print(f"\n{format_pairs(episodes, config.pairs, config.margin)}")
    print(f"\n{config.episodes} paired episodes per method; files are in {out}")


def executor(text: str, policy: VLAPolicy, config: DictConfig) -> ChunkExecutor:
    return ChunkExecutor(policy, config.n_action_steps, make_controller(text))


def evaluate(
    text: str,
    policy: VLAPolicy,
    environment: Callable[..., EnvBase],
    seeds: range,
    identity: dict,
    config: DictConfig,
) -> list[EpisodeResult]:
    """Closed-loop episodes of one method, read from its log as far as they are there."""
    settings = {"task": config.task, "horizon": config.horizon, "n_action_steps": config.n_action_steps}
    log = Path(config.out) / "episodes" / f"{text}.jsonl"
    if text == "dense" and config.dense_log is not None:
        log = Path(config.dense_log)
    with tqdm(total=len(seeds), unit="episode", desc=f"{text:>14}") as bar:
        return rollout_episodes(
            executor(text, policy, config),
            environment,
            seeds,
            num_envs=config.num_envs,
            workers=config.workers,
            backend=config.backend,
            results_file=log,
            identity=identity | settings,
            on_episode=lambda _, done, total: bar.update(done - bar.n),
            policy_device=config.device,
        )


def replay_all(policy: VLAPolicy, recorded: list[list[TensorDictBase]]) -> TensorDictBase:
    """Its answers to all recorded queries, [Q]."""
    wanted = (keys.CHUNK, keys.TOKEN_DEPTH)
    return torch.cat([replay(policy, queries, policy.pruner).select(*wanted) for queries in recorded])


def error_to_dense(dense: VLAPolicy, ours: TensorDictBase, theirs: TensorDictBase) -> tuple[float, float]:
    """Mean and maximum error of normalised actions."""
    normalize = dense.normalizer.normalize_action
    return action_error(normalize(ours[keys.CHUNK]), normalize(theirs[keys.CHUNK]))


def describe(policy: VLAPolicy, config: DictConfig) -> PolicyShape:
    return PolicyShape(
        params=sum(parameter.numel() for parameter in policy.network.parameters()),
        num_inference_steps=1,
        horizon=policy.network.config.chunk_size,
        n_obs_steps=1,
        n_action_steps=config.n_action_steps,
    )


def film(name: str, policy: VLAPolicy, env: EnvBase, config: DictConfig) -> None:
    """One episode: a video of what both cameras see and the policy keeps, a strip of it, and the controller's timeline."""
    actor = executor(name, policy, config)
    try:
        steps = env.rollout(env.base_env.horizon, actor, auto_cast_to_device=True).cpu()
    finally:
        env.close()
    layers, out = policy.network.config.llm.layers, Path(config.out)
    draw = partial(draw_tokens, num_layers=layers, scale=_ZOOM)
    pictures = [
        draw(seen_images(policy, step).numpy(), step[keys.TOKEN_DEPTH].numpy()) for step in steps.unbind(0)
    ]
    write_video(pictures, out / f"rollout_{name}.mp4", captions=captions(name, steps))
    queries = steps[keys.QUERIED].flatten().nonzero().flatten().tolist()
    shown = np.unique(np.linspace(0, len(queries) - 1, _SHOWN).round().astype(int))
    labels = [f"step {queries[index]}" for index in shown]
    plot_token_strip([pictures[queries[index]] for index in shown], labels, out / f"strip_{name}.png")
    if keys.FINE in steps.keys(True):
        plot_control(
            steps[keys.EEF_VEL][:, :3].norm(dim=-1).numpy(),
            steps[keys.FINE].flatten().numpy(),
            steps[keys.QUERIED].flatten().numpy(),
            out / f"control_{name}.png",
            kept=steps[keys.KEPT].flatten().numpy(),
        )


def captions(name: str, steps: TensorDictBase) -> list[Caption]:
    """What to write under each step's picture."""
    made, latency = [], None
    for index, step in enumerate(steps.unbind(0)):
        queried = bool(step[keys.QUERIED])
        latency = float(step[keys.LATENCY]) if queried else latency
        made.append(Caption(name, index, queried, latency, bool(step["next", keys.SUCCESS])))
    return made


if __name__ == "__main__":
    main()
