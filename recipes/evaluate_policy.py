"""Play episodes with one policy and count successes.

Kill it at any moment and run it again to go on.

    python recipes/evaluate_policy.py task=pusht policy=runs/pusht/policy episodes=20
    python recipes/evaluate_policy.py task=block_push policy=runs/block_push/policy demos=data/block_push.h5 \
        "sampler={kind: ddpm, num_inference_steps: 10}"

One line: success, the mean of the highest rewards (on Push-T the published score) and, where the task tells, the shares of
episodes that did so many of its parts and the entropy of the ways that they took. `benchmark` compares methods.
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig

from torchrl_sparse import keys
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.data.for_policy import contract_demos
from torchrl_sparse.envs.contract import task_contract
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.evaluation.statistics.intervals import wilson_interval
from torchrl_sparse.evaluation.statistics.ways import count_levels, way_entropy
from torchrl_sparse.methods.diffusion import method_identity
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps


@recipe("evaluate_policy")
def main(config: DictConfig) -> None:
    torch.set_num_threads(1)
    find_task(config.task)  # before a policy is looked for under its name
    demonstrated = demonstrated_ways(config)
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    if config.sampler is not None:
        policy.sampler = policy.sampler.variant(**config.sampler)
    episodes = play(policy, config)
    print(f"{config.policy}: {summarize(episodes)}")
    if demonstrated:
        print(f"{config.demos}: {len(demonstrated)} demonstrations, {describe_ways(demonstrated)}")


def play(policy: DiffusionPolicy, config: DictConfig) -> list[EpisodeResult]:
    """Play one episode per seed; episodes that are in the log already are read from it."""
    task = find_task(config.task)
    n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    played = {"task": task.name, "n_action_steps": n_action_steps, "horizon": config.horizon}
    first = DEVELOPMENT_SEED if config.seed is None else config.seed
    return evaluate(
        "dense",
        ChunkExecutor(policy, n_action_steps),
        diffusion_env(task.name, policy, config.horizon),
        tuning_seeds(first, config.episodes),
        num_envs=config.num_envs,
        policy_device=config.device,
        log=episode_log(config.out, "dense"),
        identity=played | method_identity("dense", policy),
    )


def summarize(episodes: list[EpisodeResult]) -> str:
    """Summarize episodes in one line."""
    n, k = len(episodes), sum(episode.success for episode in episodes)
    low, high = wilson_interval(k, n)
    scores = torch.tensor([episode.score for episode in episodes])
    spread = f" (standard error {scores.std() / n**0.5:.3f})" if n > 1 else ""  # one tells none
    told = [
        f"success {k}/{n} [{low:.2f}, {high:.2f}]",
        f"score {scores.mean():.3f}{spread}",
        f"steps {sum(episode.length for episode in episodes) / n:.1f}",
    ]
    if parts := [episode.completed for episode in episodes if episode.completed is not None]:
        told += [f"{level} {k / n:.2f}" for level, k in count_levels(parts).items()]
    if ways := [episode.way for episode in episodes if episode.way is not None]:
        told.append(describe_ways(ways))
    return ", ".join(told)


def describe_ways(ways: list[int]) -> str:
    shown = sorted({way for way in ways if way >= 0})
    counts = ", ".join(f"{ways.count(way)} of way {way}" for way in shown) or "none showed a way"
    return f"{counts}: {way_entropy(ways):.2f} bits" if shown else counts


def demonstrated_ways(config: DictConfig) -> list[int]:
    """Return which mode each demonstration takes, to compare with the policy's modes."""
    if config.demos is None:
        return []
    task = find_task(config.task)
    way_of = task.load_way_of()
    demos = contract_demos(
        config.demos, task_contract(task.name)
    )  # what tells a way sees it as the environment does
    return [way_of(demos.episode(index)[keys.STATE].numpy()) for index in range(len(demos))]


if __name__ == "__main__":
    main()
