"""Search which blocks of a cache schedule recall the query before, cell by cell, as TTS (arXiv:2605.13316) learns to.

    python recipes/search_recall.py task=lift_two_ways schedule=assets/lift_two_ways/l2c_type70_ddpm10.json

Training-free. ``recalling.json`` is the method ``recalling`` of a benchmark, and ``swapped.json``, ``swapped``, what as many
attempts find that may not recall; ``choice.json`` has their errors on noise that neither was chosen on. A search that was
killed goes on from its files.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from recipes.studies.looking.following import episode_rows, planned_queries
from torchrl_sparse.blocks.recall import RecallSchedule
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.cli.recipe import benchmark_command, recipe
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import describe_differences, write_json
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.diffusion.recall_choice import Choice, RecallJudge, climb_choice


@recipe("search_recall")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    out, schedule = Path(config.out), CacheSchedule.from_pretrained(config.schedule)
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    policy = policy.with_plan(
        None, policy.sampler.variant_named(schedule.sampler, schedule.num_inference_steps)
    )
    schedule.spec.check_is(policy.plan.spec, config.schedule)
    judges = make_judges(policy, schedule, config)
    start = Choice(schedule.mask(), torch.zeros_like(schedule.mask()))
    found = {"start": start}
    for name, recalls in (("swapped", False), ("recalling", True)):
        found[name] = climb(judges[0], start, schedule, config, out / f"{name}.json", recalls=recalls)
    results = {"task": find_task(config.task).name, "policy": policy.fingerprint, "attempts": config.attempts}
    for what, judge in zip(("seen", "error"), judges, strict=True):
        results[what] = {name: judge.error(choice) for name, choice in found.items()}
        print(f"{what}: " + ", ".join(f"{name} {error:.4f}" for name, error in results[what].items()))
    results["recalled"] = found["recalling"].recalled.float().mean().item()
    write_json(out / "choice.json", results)
    print(benchmark_command(config.task, config.policy, out, ["swapped", "recalling"]))


def make_judges(policy: DiffusionPolicy, schedule: CacheSchedule, config: DictConfig) -> list[RecallJudge]:
    """Return one to search with and, of the same queries on other noise, one that the search does not see."""
    task = find_task(config.task).name
    n_action_steps = executed_steps(task, policy.source)
    seeds = tuning_seeds(DEVELOPMENT_SEED, config.episodes)
    make_env = diffusion_env(task, policy, config.horizon)
    queries = record_queries(ChunkExecutor(policy, n_action_steps), make_env, seeds)
    encoded = planned_queries(policy, queries)
    options = {"draws": config.draws, "n_action_steps": n_action_steps, "reuse": schedule.reuse}
    episodes = [encoded[rows] for rows in episode_rows(encoded)]
    return [RecallJudge(policy, episodes, **options, seed=2 * config.seed + part) for part in range(2)]


def climb(
    judge: RecallJudge,
    start: Choice,
    schedule: CacheSchedule,
    config: DictConfig,
    path: Path,
    *,
    recalls: bool,
) -> Choice:
    """Climb from ``start``, or from where the file at ``path`` says that an earlier run came to."""
    made_for = {name: config[name] for name in ("task", "schedule", "episodes", "horizon", "draws", "seed")}
    done = 0
    if path.exists():
        written = (RecallSchedule if recalls else CacheSchedule).from_pretrained(path)
        done = written.settings.get("attempts", 0)
        if differing := describe_differences(written.settings, made_for | {"attempts": done}):
            raise ValueError(f"{path}: made with other settings: {differing}")
        mask = written.mask if recalls else written.mask()
        start = Choice(mask, written.chosen if recalls else torch.zeros_like(mask))
    keep = partial(write_choice, schedule, made_for, path, recalls=recalls)
    with tqdm(
        desc=f"{path.stem:>14}", total=config.attempts, initial=done, unit="attempt", mininterval=2
    ) as bar:

        def on_attempt(best: Choice, attempt: int) -> None:
            if attempt % config.checkpoint_every == 0:
                keep(best, attempt)
            bar.update()

        best = climb_choice(
            judge, start, config.attempts, done=done, recalls=recalls, seed=config.seed, on_attempt=on_attempt
        )
    keep(best, max(done, config.attempts))
    return best


def write_choice(
    schedule: CacheSchedule, made_for: dict, path: Path, choice: Choice, attempts: int, *, recalls: bool
) -> None:
    settings = made_for | {"attempts": attempts}
    if recalls:
        made = RecallSchedule(choice.mask, choice.recalled, schedule.spec, schedule.reuse, settings)
    else:
        spec = {"policy": schedule.policy, "sampler": schedule.sampler, "reuse": schedule.reuse}
        made = CacheSchedule.from_mask(choice.mask, method="swapped", **spec, settings=settings)
    made.save_pretrained(path)


if __name__ == "__main__":
    main()
