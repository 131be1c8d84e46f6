"""A wandb sweep without a server: wandb's own engine chooses, this keeps what it chose and what came of it."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from torchrl_sparse.evaluation.results.report import load_results
from torchrl_sparse.evaluation.results.schema import REFERENCE, validate_results
from torchrl_sparse.evaluation.results.tracking import tested_method, trial_metrics
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["LocalSweep", "Trial", "merge_trials", "read_sweep", "trial_command"]


@dataclass(frozen=True)
class Trial:
    """One trial: the id of its wandb run, which is the name of its folder too, its parameters, and whether it is through."""

    id: str
    parameters: Mapping[str, Any]
    finished: bool = False

    @property
    def label(self) -> str:
        """Its parameters in words."""
        return " ".join(f"{name}={value}" for name, value in self.parameters.items())


def read_sweep(path: str | os.PathLike) -> dict[str, Any]:
    """Read an ordinary sweep yaml and check it against wandb's own schema.

    Raises:
        FileNotFoundError: if there is none.
        ImportError: without the ``sweeps`` package.
        ValueError: if wandb would refuse it; the message names the file and says why.
    """
    config = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    violations = _engine().config.cfg.schema_violations_from_proposed_config(config)
    if violations:
        raise ValueError(f"{path}: expected a wandb sweep, got {'; '.join(violations)}")
    return config


class LocalSweep:
    """The trials of a sweep in a folder. Chosen parameters are on disk before their trial begins, so a kill loses none.

    Args:
        config: the sweep.
        out: the folder; an earlier one of the same sweep is gone on with.
        count: trials in all; None runs until the engine has no more, as a grid does.

    Raises:
        ValueError: if the folder holds another sweep, or a search without end has no ``count``.
    """

    def __init__(self, config: Mapping[str, Any], out: str | os.PathLike, count: int | None = None) -> None:
        self.config, self.out, self.count = dict(config), Path(out), count
        self.trials: list[Trial] = []
        if count is None and config["method"] != "grid":
            raise ValueError(f"count: expected a number of trials for method {config['method']!r}, got None")
        if self._file.exists():
            found = json.loads(self._file.read_text(encoding="utf-8"))
            if found["config"] != json.loads(json.dumps(self.config)):
                raise ValueError(
                    f"{self._file}: holds another sweep than the one asked for; choose another out"
                )
            self.trials = [Trial(**trial) for trial in found["trials"]]

    @property
    def _file(self) -> Path:
        return self.out / "sweep.json"

    def results_file(self, trial: Trial) -> Path:
        """Where a trial's results are once it is finished."""
        return self.out / trial.id / "results.json"

    def next_trial(self) -> Trial | None:
        """The trial to run now: one that was killed, or a new one that the engine chooses; None at the end."""
        for trial in self.trials:
            if not trial.finished:
                return trial
        if self.count is not None and len(self.trials) >= self.count:
            return None
        chosen = _engine().next_run(self.config, [self._as_run(trial) for trial in self.trials])
        if chosen is None:
            return None
        values = {name: entry["value"] for name, entry in chosen.config.items()}
        self.trials.append(Trial(f"{self.out.name}-{secrets.token_hex(4)}", values))
        self._save()
        return self.trials[-1]

    def finish(self, trial: Trial) -> None:
        """Note that a trial is through.

        Raises:
            FileNotFoundError: if it left no results.
        """
        if not self.results_file(trial).exists():
            raise FileNotFoundError(f"trial {trial.label}: expected {self.results_file(trial)}, got none")
        self.trials[self.trials.index(trial)] = replace(trial, finished=True)
        self._save()

    def results(self) -> list[tuple[Trial, dict[str, Any]]]:
        """The finished trials and what they found, in the order in which they were chosen."""
        return [(trial, load_results(self.results_file(trial))) for trial in self.trials if trial.finished]

    def _save(self) -> None:
        text = json.dumps(
            {"config": self.config, "trials": [asdict(trial) for trial in self.trials]}, indent=1
        )
        with atomic_path(self._file) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def _as_run(self, trial: Trial) -> Any:
        engine, metrics = _engine(), trial_metrics(load_results(self.results_file(trial)))
        return engine.SweepRun(
            name=trial.id,
            config={name: {"value": value} for name, value in trial.parameters.items()},
            state=engine.RunState.finished,
            summaryMetrics=metrics,
            history=[metrics],
        )


def trial_command(config: Mapping[str, Any], trial: Trial) -> list[str]:
    """The command line of a trial, as wandb's agent would run it."""
    from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

    arguments = create_sweep_command_args({"args": {k: {"value": v} for k, v in trial.parameters.items()}})
    macros = {"program": [config["program"]], "interpreter": ["python"], "env": ["/usr/bin/env"], **arguments}
    return [
        str(word)
        for chunk in create_sweep_command(list(config["command"]))
        for word in macros.get(chunk[2:-1] if chunk.startswith("${") else "", [chunk])
    ]


def merge_trials(trials: Sequence[tuple[Trial, Mapping[str, Any]]]) -> dict[str, Any]:
    """One ``results.json`` of a sweep: dense, and what each trial tested, by its name or, where trials share that, by label.

    Latencies come from the trials' own processes, each with its own dense for ``speedup_vs_dense``; the dense entry
    is the first trial's.

    Raises:
        ValueError: if there is no trial, or trials differ in their numbers of episodes.
    """
    if not trials:
        raise ValueError("trials: expected at least one finished, got none")
    first = trials[0][1]
    names = [tested_method(results) for _, results in trials]
    if len({REFERENCE, *names}) <= len(names):
        names = [trial.label for trial, _ in trials]
    tested = {
        name: results["methods"][tested_method(results)]
        for name, (_, results) in zip(names, trials, strict=True)
    }
    merged = {**first, "methods": {REFERENCE: first["methods"][REFERENCE], **tested}}
    validate_results(merged)
    return merged


def _engine() -> Any:
    try:
        import sweeps
        import sweeps.config.cfg
    except ImportError as error:
        raise ImportError(
            "a sweep without a server needs wandb's engine: pip install 'torchrl-sparse[sweeps]'"
        ) from error
    return sweeps
