"""Run an ordinary wandb sweep yaml; kill it at any moment and run it again to go on.

    python recipes/sweep.py sweep=rho_lift                   # no server: wandb's own engine, runs kept offline
    wandb sync outputs/sweeps/rho_lift/*/wandb/offline-run-*            # whenever there is one
    python recipes/sweep.py sweep=rho_lift mode=online       # creates the sweep and runs an agent

The same file works with `wandb sweep recipes/sweeps/rho_lift.yaml` and `wandb agent`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.results.report import format_table
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.sweeps import (
    LocalSweep,
    lock_folder,
    merge_trials,
    read_sweep,
    run_trial,
    write_trials,
)
from torchrl_sparse.storage.atomic import atomic_path

RECIPES = Path(__file__).parent


@hydra.main(version_base=None, config_path=".", config_name="sweep")
def main(config: DictConfig) -> None:
    path = (
        Path(config.sweep) if config.sweep.endswith(".yaml") else RECIPES / "sweeps" / f"{config.sweep}.yaml"
    )
    out = Path(config.out).resolve()
    os.environ["SWEEP_OUT"] = str(out)
    os.environ["PATH"] = (
        f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # `python` is this one
    )
    if config.mode == "online":
        run_online(read_sweep(path), out, config)
        return
    with lock_folder(out) as lock:
        sweep = LocalSweep(read_sweep(path), out, config.count)
        while trial := sweep.next_trial():
            print(f"trial {sweep.trials.index(trial) + 1}: {trial.label}", flush=True)
            run_trial(sweep, trial, lock)
        summarise(sweep)


def run_online(sweep: dict, out: Path, config: DictConfig) -> None:
    """Create the sweep, unless an earlier call did, and run its trials here."""
    import wandb

    note = out / "sweep_id"
    if not note.exists():
        with atomic_path(note) as temporary:
            temporary.write_text(wandb.sweep(sweep, project=config.project))
    wandb.agent(note.read_text(), project=config.project, count=config.count)


def summarise(sweep: LocalSweep) -> None:
    """Write a table and a Pareto picture of all trials."""
    trials = sweep.results()
    results = merge_trials(trials)
    save_results(results, sweep.out / "results.json")
    plot_pareto(results, sweep.out / "pareto.png")
    write_trials(trials, sweep.out / "trials.csv")
    print(f"\n{format_table(results)}\n\n{len(trials)} trials; files are in {sweep.out}")


if __name__ == "__main__":
    main()
