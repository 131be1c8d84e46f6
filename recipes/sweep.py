"""Runs an ordinary wandb sweep yaml; kill it at any moment and run it again to go on.

    python recipes/sweep.py sweep=rho_lift                   # no server: wandb's own engine, runs kept offline
    wandb sync outputs/sweeps/rho_lift/*/wandb/offline-run-*            # whenever there is one
    python recipes/sweep.py sweep=rho_lift mode=online       # creates the sweep and runs an agent

The same file works with `wandb sweep recipes/sweeps/rho_lift.yaml` and `wandb agent`.
"""

from __future__ import annotations

import csv
import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_sparse.evaluation.figures.plots import plot_pareto
from torchrl_sparse.evaluation.results.report import format_table, save_results
from torchrl_sparse.evaluation.results.sweeps import (
    LocalSweep,
    Trial,
    merge_trials,
    read_sweep,
    trial_command,
)
from torchrl_sparse.evaluation.results.tracking import trial_metrics
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


@contextmanager
def lock_folder(out: Path) -> Iterator[int]:
    """Waits until nothing else works in the folder; the trial inherits the lock, since it outlives a sweep that is killed."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"waiting for a trial that still runs in {out}", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def run_online(sweep: dict, out: Path, config: DictConfig) -> None:
    """Creates the sweep, unless an earlier call did, and runs its trials here."""
    import wandb

    note = out / "sweep_id"
    if not note.exists():
        with atomic_path(note) as temporary:
            temporary.write_text(wandb.sweep(sweep, project=config.project))
    wandb.agent(note.read_text(), project=config.project, count=config.count)


def run_trial(sweep: LocalSweep, trial: Trial, lock: int) -> None:
    environment = os.environ | {
        "WANDB_MODE": "offline",
        "WANDB_RUN_ID": trial.id,
        "WANDB_RUN_GROUP": sweep.out.name,
    }
    command = trial_command(sweep.config, trial)
    code = subprocess.run(command, env=environment, pass_fds=[lock]).returncode
    if code:
        raise RuntimeError(f"trial {trial.label}: expected exit code 0, got {code} from {' '.join(command)}")
    sweep.finish(trial)


def summarise(sweep: LocalSweep) -> None:
    """A table and a Pareto picture of all trials."""
    trials = sweep.results()
    results = merge_trials(trials)
    save_results(results, sweep.out / "results.json")
    plot_pareto(results, sweep.out / "pareto.png")
    rows = [{**t.parameters, **select(trial_metrics(r)), "run": t.id} for t, r in trials]
    with atomic_path(sweep.out / "trials.csv") as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(f"\n{format_table(results)}\n\n{len(rows)} trials; files are in {sweep.out}")


def select(metrics: dict[str, float]) -> dict[str, float]:
    """What was tested, without the prefix."""
    return {
        name.removeprefix("tested/"): value for name, value in metrics.items() if name.startswith("tested/")
    }


if __name__ == "__main__":
    main()
