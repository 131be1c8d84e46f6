"""Run a W&B sweep file, with a server or without.

Kill it at any moment and run it again to go on.

    python recipes/sweep.py sweep=rho_lift                   # no server: wandb's own engine, runs kept offline
    wandb sync outputs/sweeps/rho_lift/*/wandb/offline-run-*            # whenever there is one
    python recipes/sweep.py sweep=rho_lift mode=online       # creates the sweep and runs an agent

The same file works with `wandb sweep recipes/sweeps/rho_lift.yaml` and `wandb agent`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.cli.sweep_files import find_program, read_sweep
from torchrl_sparse.cli.sweeps import (
    LocalSweep,
    ServedSweep,
    merge_trials,
    run_trial,
    write_trials,
)
from torchrl_sparse.cli.trials import check_served, check_trials
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.results.report import format_table
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.runtime.lock import lock_output
from torchrl_sparse.storage.json import describe_differences, read_json, write_json

RECIPES = Path(__file__).parent


@recipe("sweep", out=None)
def main(config: DictConfig) -> None:
    file = find_sweep(config.sweep)
    settings, out = read_sweep(file), Path(config.out).resolve()
    os.environ["SWEEP_OUT"] = str(out)
    check_trials(file, settings)
    os.environ["PATH"] = (
        f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # `python` is this one
    )
    if config.mode == "online":
        check_served(file, settings, config.project)
        run_online(settings, out, config)
        return
    with lock_output(out) as lock:
        sweep = LocalSweep(settings, out, config.count)
        while trial := sweep.next_trial():
            print(f"trial {sweep.trials.index(trial) + 1}: {trial.label}", flush=True)
            run_trial(sweep, trial, lock)
        summarise(sweep)


def find_sweep(name: str) -> Path:
    """Return the path of a sweep file, given the name of one of the library's sweeps or any path."""
    known = {path.stem: path for path in sorted((RECIPES / "sweeps").glob("*.yaml"))}
    path = Path(name) if name.endswith(".yaml") else known.get(name)
    if path is None or not path.is_file():
        raise FileNotFoundError(f"sweep: expected one of {', '.join(known)} or a yaml file, got {name!r}")
    return path


def run_online(sweep: dict, out: Path, config: DictConfig) -> None:
    """Create the sweep unless an earlier call did, and run its trials here."""
    import wandb

    path, made_for = out / "sweep.json", {"project": config.project, "sweep": sweep}
    if not path.exists():
        program = {"program": str(find_program(sweep["program"]))}
        write_json(
            path,
            ServedSweep(
                wandb.sweep(sweep | program, entity=sweep.get("entity"), project=config.project), made_for
            ),
        )
    note = read_json(path, ServedSweep)
    if differing := describe_differences(note.made_for, made_for):
        raise InputError(f"out: {path} is of another sweep: {differing}; choose another out or move it away")
    wandb.agent(note.sweep_id, entity=sweep.get("entity"), project=config.project, count=config.count)


def summarise(sweep: LocalSweep) -> None:
    """Write a table and a Pareto picture of all trials."""
    trials = sweep.results()
    results = merge_trials(trials)
    save_results(results, sweep.out / "results.json")
    plot_pareto(results, sweep.out / "pareto.png")
    write_trials(trials, sweep.out / "trials.csv")
    print(f"\n{format_table(results)}\n\n{CAPTION}\n{len(trials)} trials; files are in {sweep.out}")


CAPTION = (
    "Each method was timed in the process of its own trial, interleaved with that trial's dense, which its speed-up is "
    "relative to; between trials nothing was interleaved. Dense is that of the first trial."
)


if __name__ == "__main__":
    main()
