"""Checks of a sweep's trials by their recipes' own rules, before the first one runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

from torchrl_sparse.cli.recipe import check_command
from torchrl_sparse.cli.sweep_files import (
    find_program,
    hydra_word,
    parameter_sets,
    parameter_values,
    trial_command,
)
from torchrl_sparse.cli.sweeps import Trial
from torchrl_sparse.errors import InputError

__all__ = ["check_served", "check_trials"]


def check_trials(file: Path, settings: Mapping[str, Any]) -> None:
    """Check every trial's command line as its recipe will, before the first one runs.

    Raises:
        InputError: naming file, trial and option.
    """
    program = find_program(settings["program"])
    with patch.dict(os.environ, WANDB_RUN_ID="trial"):  # which options may refer to
        _check_trials(file, settings, program)


def _check_trials(file: Path, settings: Mapping[str, Any], program: Path) -> None:
    for parameters in parameter_sets(settings):
        words = trial_command(settings, parameters)
        try:
            check_command(program, words[words.index(str(program)) + 1 :])
        except ValueError as error:
            raise InputError(f"{file}: trial {Trial('', dict(parameters)).label}: {error}") from error


def check_served(file: Path, settings: Mapping[str, Any], project: str) -> None:
    """Refuse parameters that W&B's own agent would pass in a form that Hydra cannot read, or to another project."""
    for name, entry in settings["parameters"].items():
        for option, value in parameter_values(name, entry):
            if option != name or _agent_changes(value):
                raise InputError(
                    f"{file}: {option}: expected numbers, plain words or lists of them with mode=online, whose agent writes "
                    f"null, mappings and texts such as 'true' or 'a=b' as Hydra does not read them, got {value!r}"
                )
    if settings.get("project", project) != project:
        raise InputError(f"project: expected that of {file}, {settings['project']!r}, got {project!r}")


def _agent_changes(value: Any) -> bool:
    """Tell whether Hydra would misread a value as W&B's agent writes it, in Python's notation."""
    if isinstance(value, list):
        return any(isinstance(entry, (list, dict)) or entry is None for entry in value)
    return value is None or isinstance(value, dict) or (isinstance(value, str) and hydra_word(value) != value)
