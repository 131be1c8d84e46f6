"""Pick the fastest way to run a policy that is still right.

Calibrate, time, rank, play, choose, save.

    python recipes/accelerate_policy.py task=lift policy=latest.ckpt demos=data/lift.h5 budget_ms=5 out=runs/fast
    python recipes/accelerate_policy.py task=lift policy=assets/lift demos=data/lift.h5 episodes=0

The first plays the best candidates that keep the budget against the dense policy until their verdicts are reached; the second
ranks offline and needs no simulator. ``out/policy`` is for `DiffusionPolicy.from_pretrained`, with its sampler and planner
installed and a card beside it. Kill it and run it again to go on.
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.accelerate import (
    Grid,
    Request,
    accelerate,
    film_chosen,
    save_policy,
    write_acceleration_report,
)
from torchrl_sparse.evaluation.results.acceleration import acceleration_note, acceleration_rows
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.pruner.config import PrunerConfig


@recipe("accelerate_policy")
def main(config: DictConfig) -> None:
    out, task = Path(config.out), find_task(config.task)
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine).to(config.device)
    n_action_steps = executed_steps(task.name, policy.source, config.n_action_steps)
    options = {name: config[name] for name in SHARED_OPTIONS}
    request = Request(task.name, **options, n_action_steps=n_action_steps, repeats=config.latency_repeats)
    grid = Grid(**{name: tuple(values) for name, values in config.candidates.items()})
    pruner = PrunerConfig(**OmegaConf.to_container(config.pruner)) if config.train else None
    demos = policy_demos(config.demos, task.name, policy)
    make_env = diffusion_env(task.name, policy, config.horizon)
    found, methods = accelerate(
        policy,
        demos,
        out,
        request,
        made_for={"demos": config.demos},
        grid=grid,
        pruner=pruner,
        make_env=make_env,
    )
    chosen = methods[found.chosen]
    save_policy(found, chosen, out / "policy", n_action_steps=n_action_steps)
    if config.episodes:
        try:
            film_chosen(found, chosen, make_env, out, n_action_steps=n_action_steps, seed=config.seed)
        except RuntimeError as error:  # no GL library
            print(f"no video: {error}")
    report = write_acceleration_report(found, out)
    print(f"\n{markdown_table(acceleration_rows(found))}\n\n{acceleration_note(found)}\n")
    print(f'{report}: the report\n{out}/policy: for DiffusionPolicy.from_pretrained("{out}/policy")')
    print(
        f"On other seeds: python recipes/benchmark.py task={config.task} policy={config.policy} planners={out}/planners "
        f"methods=[dense,{found.chosen}] split=test until=decided out={out}/test"
    )


SHARED_OPTIONS = (
    *("budget_ms", "episodes", "finalists", "margin", "time_margin"),
    *("windows", "seed", "threads", "workers"),
)
"""Options that `Request` calls the same."""


if __name__ == "__main__":
    main()
