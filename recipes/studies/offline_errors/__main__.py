"""Measure how methods change a policy's actions, and whether that predicts how its episodes go.

    python -m recipes.studies.offline_errors task=can demos=data/can.h5 results=[assets/can/weaker/results_300.json]

No simulator is needed: demonstrations are asked many times, and the tables of episodes were made before. What was measured on
several tasks is put together:

    python -m recipes.studies.offline_errors aggregate=[runs/offline_errors_Lift.json,runs/offline_errors_PickPlaceCan.json]
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from omegaconf import DictConfig
from pydantic import Field
from tqdm import tqdm

from recipes.studies.offline_errors.agreement import agreement_of, save_agreement, together_rows
from recipes.studies.offline_errors.agreement_figure import plot_agreement
from recipes.studies.offline_errors.errors import OfflineErrors, draw_answers, offline_errors
from recipes.studies.offline_errors.figure import plot_offline
from recipes.studies.offline_errors.results import (
    OfflineResults,
    agreement_rows,
    error_rows,
    load_offline,
    outcomes,
    save_offline,
)
from torchrl_sparse.cli.options import Word, Words
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods
from torchrl_sparse.evaluation.results.schema import DENSE, load_results
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.diffusion.targets import make_targets

OPTIONS = {"draws": Annotated[int, Field(ge=3)], "results": Words, "aggregate": list[Word]}
"""Options that no recipe of the library has -> type."""


@recipe("offline_errors", options=OPTIONS)
def main(config: DictConfig) -> None:
    if config.aggregate:
        put_together(config.aggregate, Path(config.out))
        return
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy, task = DiffusionPolicy.from_pretrained(config.policy).to(config.device), find_task(config.task)
    played = read_tables(config, task.name)
    n_action_steps = executed_steps(task.name, policy.source)
    demos = policy_demos(config.demos, task.name, policy)
    targets = make_targets(policy, demos, source="data", n_action_steps=n_action_steps, **config.targets)
    methods = make_methods(
        dict.fromkeys(name for table in played.values() for name in table),
        policy,
        num_updates=config.num_updates,
        planners=Path(config.planners),
        calibration=no_calibration,
    )
    errors = measure(methods, targets, config, n_action_steps)
    sizes = (len(targets), config.draws, config.targets.seed)
    results = OfflineResults(1, task.name, policy.fingerprint, *sizes, errors, played)
    path = Path(config.out) / f"offline_errors_{task.name}.json"
    save_offline(results, path)
    plot_offline(results, next(iter(played)), path.with_suffix(".png"))
    for rows in (error_rows(results), agreement_rows(results)):
        print(f"\n{markdown_table(rows)}")


def put_together(paths: Sequence[str], out: Path) -> None:
    """Write and show, over several tasks, which action measure predicts the results of episodes."""
    agreement = agreement_of([load_offline(path) for path in paths])
    save_agreement(agreement, out / "offline_agreement.json")
    plot_agreement(agreement, out / "offline_agreement.png")
    for outcome, rows in together_rows(agreement).items():
        print(f"\nrank correlation with {outcome}\n\n{markdown_table(rows)}")


def read_tables(config: DictConfig, task: str) -> dict[str, Any]:
    """Return each table's episode results, for the methods that differ from dense in their actions alone."""
    played = {}
    for path in config.results:
        results = load_results(path)
        if results.task != task:
            raise InputError(f"results: {path}: expected a table of {task}, got one of {results.task}")
        found = outcomes(results).items()
        played[path] = {name: outcome for name, outcome in found if answers_alone(MethodSpec.parse(name))}
    return played


def answers_alone(name: MethodSpec) -> bool:
    """Tell whether a method changes only the actions, not how often or how many times the policy is called."""
    return name.every is None and name.samples == 1 and not name.ensembled and not name.ahead


def no_calibration() -> Any:
    raise InputError("planners: expected the BAC schedules of the tables, got a folder without one of them")


def measure(
    methods: dict[str, DiffusionPolicy], targets: Any, config: DictConfig, n_action_steps: int
) -> dict[str, OfflineErrors]:
    """Sample the actions of dense, twice, and of every method, each with independent noise."""
    options = {"draws": config.draws, "n_action_steps": n_action_steps}
    first = methods[DENSE].n_obs_steps - 1
    wanted = targets["target"][:, first : first + n_action_steps].flatten(1)
    dense = draw_answers(methods[DENSE], targets, **options, seed=config.targets.seed)
    errors = {}
    for number, (name, method) in enumerate(tqdm(methods.items(), unit="method", mininterval=2), 1):
        answers = draw_answers(method, targets, **options, seed=config.targets.seed + number)
        errors[name] = offline_errors(answers, wanted, dense)
    return errors


if __name__ == "__main__":
    main()
