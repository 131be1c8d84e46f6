"""Wandb sweeps without a server: wandb's own engine chooses trials, and this module stores trials and results."""

from __future__ import annotations

import csv
import os
import secrets
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_sparse.cli.sweep_files import sweep_engine, trial_command
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.schema import DENSE, Results, load_results
from torchrl_sparse.evaluation.results.tracking import tested_method, trial_metrics
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import describe_differences, read_json, to_plain, write_json

__all__ = [
    "LocalSweep",
    "ServedSweep",
    "Trial",
    "merge_trials",
    "run_trial",
    "write_trials",
]


@dataclass(frozen=True)
class Trial:
    """One trial: the id of its wandb run, which also names its folder; its parameters; and whether it has finished."""

    id: str
    parameters: dict[str, Any]
    finished: bool = False

    @property
    def label(self) -> str:
        """The trial's parameters as text."""
        return " ".join(f"{name}={value}" for name, value in self.parameters.items())


@dataclass(frozen=True)
class SavedSweep:
    """The content of a ``sweep.json``: the sweep, and its trials in the order in which they were chosen."""

    config: dict[str, Any]
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class ServedSweep:
    """The content of the ``sweep.json`` of a sweep on W&B's server: its id there, and the settings that it was made for."""

    sweep_id: str
    made_for: dict[str, Any]


class LocalSweep:
    """The trials of a sweep in a folder. Parameters are on disk before their trial begins, so a kill loses none.

    Args:
        config: the sweep.
        out: the folder; an earlier one of the same sweep is resumed, another of which no trial finished is forgotten.
        count: trials in all, of which there are no more than the sweep's ``run_cap``; None runs until the engine has no more,
            as a grid does.

    Raises:
        InputError: if the folder holds another sweep, or a search without end has no ``count``.
    """

    def __init__(self, config: Mapping[str, Any], out: str | os.PathLike, count: int | None = None) -> None:
        caps = [cap for cap in (count, config.get("run_cap")) if cap is not None]
        self.config, self.out, self.count = dict(config), Path(out), min(caps, default=None)
        self.trials: list[Trial] = []
        if self.count is None and config["method"] != "grid":
            raise InputError(f"count: expected a number of trials for method {config['method']!r}, got None")
        if self._file.exists():
            found = read_json(self._file, SavedSweep)
            if not (differing := describe_differences(found.config, to_plain(self.config))):
                self.trials = list(found.trials)
            elif any(trial.finished for trial in found.trials):
                raise InputError(
                    f"{self._file}: holds another sweep: {differing}; choose another out or move it away"
                )

    @property
    def _file(self) -> Path:
        return self.out / "sweep.json"

    def results_file(self, trial: Trial) -> Path:
        """Return the path of a trial's results, which exists once the trial has finished."""
        return self.out / trial.id / "results.json"

    def next_trial(self) -> Trial | None:
        """Return the next trial: an interrupted one, or a new one from the engine; None at the end."""
        for trial in self.trials:
            if not trial.finished:
                return trial
        if self.count is not None and len(self.trials) >= self.count:
            return None
        chosen = sweep_engine().next_run(self.config, [self._as_run(trial) for trial in self.trials])
        if chosen is None:
            return None
        values = {name: _plain(entry["value"]) for name, entry in chosen.config.items()}
        self.trials.append(Trial(f"{self.out.name}-{secrets.token_hex(4)}", values))
        self._save()
        return self.trials[-1]

    def finish(self, trial: Trial) -> None:
        """Mark a trial as finished.

        Raises:
            FileNotFoundError: if it left no results.
        """
        if not self.results_file(trial).exists():
            raise FileNotFoundError(f"trial {trial.label}: expected {self.results_file(trial)}, got none")
        self.trials[self.trials.index(trial)] = replace(trial, finished=True)
        self._save()

    def results(self) -> list[tuple[Trial, Results]]:
        """Return the finished trials and their results, in the order in which they were chosen."""
        return [(trial, load_results(self.results_file(trial))) for trial in self.trials if trial.finished]

    def _save(self) -> None:
        write_json(self._file, SavedSweep(self.config, tuple(self.trials)))

    def _as_run(self, trial: Trial) -> Any:
        engine, metrics = sweep_engine(), trial_metrics(load_results(self.results_file(trial)))
        wanted = (self.config.get("metric") or {}).get("name")
        if self.config["method"] == "bayes" and wanted not in metrics:
            raise InputError(f"metric.name: expected one of {', '.join(metrics)}, got {wanted!r}")
        return engine.SweepRun(
            name=trial.id,
            config={name: {"value": value} for name, value in trial.parameters.items()},
            state=engine.RunState.finished,
            summaryMetrics=metrics,
            history=[metrics],
        )


def run_trial(sweep: LocalSweep, trial: Trial, lock: int) -> None:
    """Run a trial to its end as one offline wandb run.

    Raises:
        RunFailed: if its command fails.
        FileNotFoundError: if it left no results.
    """
    environment = os.environ | {
        "WANDB_MODE": "offline",
        "WANDB_RUN_ID": trial.id,
        "WANDB_RUN_GROUP": sweep.out.name,
    }
    command = trial_command(sweep.config, trial.parameters)
    code = subprocess.run(command, env=environment, pass_fds=[lock]).returncode
    if code:
        raise RunFailed(f"trial {trial.label}: expected exit code 0, got {code} from {' '.join(command)}")
    sweep.finish(trial)


def write_trials(trials: Sequence[tuple[Trial, Results]], path: str | os.PathLike) -> None:
    """Write a CSV file with one line per trial: parameters, results of the tested method, and run id."""
    rows = [{**trial.parameters, **_tested(results), "run": trial.id} for trial, results in trials]
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _tested(results: Results) -> dict[str, float]:
    prefix = "tested/"
    metrics = trial_metrics(results).items()
    return {name.removeprefix(prefix): value for name, value in metrics if name.startswith(prefix)}


def merge_trials(trials: Sequence[tuple[Trial, Results]]) -> Results:
    """Merge a sweep's results: dense, and each trial's tested method under its name, or its label if names repeat.

    Latencies come from the trials' own processes, each with its own dense for ``speedup_vs_dense``; the dense entry
    is the first trial's.

    Raises:
        InputError: if there is no trial, or trials differ in their numbers of episodes.
    """
    if not trials:
        raise InputError("trials: expected at least one finished, got none")
    first = trials[0][1]
    names = [tested_method(results) for _, results in trials]
    if len({DENSE, *names}) <= len(names):
        names = [trial.label for trial, _ in trials]
    tested = {
        name: results.methods[tested_method(results)]
        for name, (_, results) in zip(names, trials, strict=True)
    }
    return replace(first, methods={DENSE: first.dense, **tested})


def _plain(value: Any) -> Any:
    """Return a draw of the engine as JSON has it: some of its distributions draw numbers of numpy."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return value.item() if isinstance(value, np.generic) else value
