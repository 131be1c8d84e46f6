"""Wandb sweep files: the supported subset, and the command line of each trial."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.yaml import read_yaml

__all__ = ["find_program", "hydra_word", "parameter_sets", "read_sweep", "sweep_engine", "trial_command"]

_METHODS = ("grid", "random", "bayes")
_HONOURED = (
    "program", "method", "metric", "parameters", "command", "run_cap", "name", "description", "project", "entity",
)  # fmt: skip
_NOT_HONOURED = {
    "early_terminate": "no early_terminate: a trial reports once, at its end, so nothing can be stopped",
    "controller": "no controller: trials are chosen on this machine (mode=offline) or on W&B's server (mode=online)",
}
DEFAULT_COMMAND = (
    "${env}", "python", "${program}", "${args_no_hyphens}", "split=development", "seed=50000", "logger=wandb",
    "out=${oc.env:SWEEP_OUT}/${oc.env:WANDB_RUN_ID}", "dense_log=${oc.env:SWEEP_OUT}/dense.jsonl",
)  # fmt: skip
"""Command of a file that names none: wandb's own has hyphens, which Hydra refuses, and no folder of a trial's own."""


def read_sweep(path: str | os.PathLike) -> dict[str, Any]:
    """Read a wandb sweep YAML and check it against wandb's own schema.

    A file without ``command`` gets `DEFAULT_COMMAND`.

    Raises:
        FileNotFoundError: if there is none.
        ImportError: without the ``sweeps`` package.
        InputError: if wandb would refuse it, an entry would not be honoured, or its trials would see test seeds; the message
            names file and entry.
    """
    written = read_yaml(path)
    if not isinstance(written, dict):
        raise InputError(f"{path}: expected a wandb sweep, got {type(written).__name__}")
    config: dict[str, Any] = {"command": [*DEFAULT_COMMAND], **written}
    _check_entries(path, config)
    _check_parameters(path, config["parameters"])
    _check_command(path, config)
    check = sweep_engine().config.cfg.schema_violations_from_proposed_config
    try:
        violations = check(config)
    except ValueError as error:
        violations = [str(error)]
    if violations:
        raise InputError(f"{path}: expected a wandb sweep, got {'; '.join(violations)}")
    split = config["parameters"].get("split", {})
    said = {str(word).lstrip("+") for word in config["command"]}
    if "split=test" in said or "test" in [split.get("value"), *split.get("values", [])]:
        raise InputError(f"{path}: split: expected development, got test: a sweep tunes")
    return config


def _check_entries(path: str | os.PathLike, config: Mapping[str, Any]) -> None:
    """Refuse, by name, entries that are not honoured, and those that a trial is made from and that are of no use."""
    for name, value in config.items():
        if name not in _HONOURED:
            expected = _NOT_HONOURED.get(name, f"some of {', '.join(_HONOURED)}")
            raise InputError(f"{path}: {name}: expected {expected}, got {value!r}")
    kinds = {"program": str, "method": str, "parameters": dict, "command": list}
    for name, kind in kinds.items():
        if not isinstance(config.get(name), kind):
            raise InputError(f"{path}: {name}: expected a {kind.__name__}, got {config.get(name)!r}")
    if config["method"] not in _METHODS:
        raise InputError(f"{path}: method: expected one of {', '.join(_METHODS)}, got {config['method']!r}")


def _check_parameters(path: str | os.PathLike, parameters: Mapping[str, Any]) -> None:
    """Refuse, by name, values that a trial would read as others, and options that two parameters set."""
    options: list[str] = []
    for name, entry in parameters.items():
        found: set[str] = set()
        for option, value in parameter_values(name, entry):
            found |= {f"{option}.{inner}" for inner in value} if isinstance(value, dict) else {option}
            if not _arrives(value):
                expected = "a value that Hydra reads as it stands, without ${...} and other marks in names"
                raise InputError(f"{path}: {option}: expected {expected}, got {value!r}")
        options += [option.lstrip("+") for option in found]
    if twice := sorted({option for option in options if options.count(option) > 1}):
        raise InputError(f"{path}: parameters: expected each option once, got {', '.join(twice)} twice")


def parameter_values(name: str, entry: Any) -> Iterator[tuple[str, Any]]:
    """Yield the options that a parameter sets, with each value listed in the file; a distribution lists none.

    >>> list(parameter_values("sampler", {"parameters": {"kind": {"values": ["ddim", "ddpm"]}}}))
    [('sampler.kind', 'ddim'), ('sampler.kind', 'ddpm')]
    """
    entry = entry if isinstance(entry, dict) else {}
    for inner, nested in entry.get("parameters", {}).items():
        yield from parameter_values(f"{name}.{inner}", nested)
    values = entry.get("values", [])
    yield from ((name, value) for value in (values if isinstance(values, list) else [values]))
    if "value" in entry:
        yield name, entry["value"]


def _arrives(value: Any) -> bool:
    """Tell whether a trial reads a value as it stands, or, of a text in brackets, what it says."""
    word = hydra_word(value)
    in_brackets = isinstance(value, str) and word == value and value[:1] in ("[", "{")
    return "${" not in word and (in_brackets or _read_by_hydra(word) == value)


def _check_command(path: str | os.PathLike, config: dict[str, Any]) -> None:
    """Refuse a command under which parameters would reach no trial or stand twice, and a metric that steers nothing.

    Words of `DEFAULT_COMMAND` give way to parameters of their name.
    """
    parameters = config["parameters"]
    if config["command"] == [*DEFAULT_COMMAND]:
        config["command"] = [word for word in DEFAULT_COMMAND if word.partition("=")[0] not in parameters]
    named = {str(word).partition("=")[0].lstrip("+") for word in config["command"]}
    if twice := sorted(named & parameters.keys()):
        raise InputError(f"{path}: command: expected no parameter in it, got {', '.join(twice)}")
    for macro in ("${program}", "${args"):
        if not any(str(word).startswith(macro) for word in config["command"]):
            expected = "${program} and ${args_no_hyphens} among its words"
            raise InputError(f"{path}: command: expected {expected}, got {config['command']}")
    metric = config.get("metric", {})
    if not isinstance(metric, dict):
        raise InputError(f"{path}: metric: expected a name and a goal, got {metric!r}")
    if config["method"] == "bayes" and "goal" not in metric:
        raise InputError(f"{path}: metric.goal: expected maximize or minimize, got {metric}")
    if "target" in metric:
        raise InputError(f"{path}: metric.target: expected none: a sweep runs all its trials")


def parameter_sets(config: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield parameters of possible trials: the full grid, or each value or range end with the others at their first.

    Args:
        config: a sweep, see `read_sweep`.
    """
    values = {name: _values(entry) for name, entry in config["parameters"].items()}
    if config["method"] == "grid":
        yield from (dict(zip(values, chosen, strict=True)) for chosen in product(*values.values()))
        return
    first = {name: of_one[0] for name, of_one in values.items()}
    yield from (first | {name: value} for name, of_one in values.items() for value in of_one)


def _values(entry: Mapping[str, Any]) -> list[Any]:
    if "parameters" in entry:
        inner = {name: _values(nested) for name, nested in entry["parameters"].items()}
        return [dict(zip(inner, chosen, strict=True)) for chosen in product(*inner.values())]
    if "value" in entry:
        return [entry["value"]]
    if "values" in entry:
        return list(entry["values"])
    from sweeps.params import HyperParameter

    parameter = HyperParameter("draw", dict(entry))
    return [np.asarray(parameter.ppf(quantile)).item() for quantile in (0.001, 0.999)]


def trial_command(config: Mapping[str, Any], parameters: Mapping[str, Any]) -> list[str]:
    """Return the command line of a trial, as wandb's agent would run it.

    Where that writes a value as Hydra does not read it (``None``, mappings), this writes what Hydra reads, see `hydra_word`.
    """
    from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

    arguments = create_sweep_command_args({"args": {k: {"value": v} for k, v in parameters.items()}})
    words = [f"{name}={hydra_word(value)}" for name, value in parameters.items()]
    read_by_hydra = {
        "args_no_hyphens": words,
        "args_append_hydra": [f"+{word}" for word in words],
        "args_override_hydra": [f"++{word}" for word in words],
    }
    macros = {
        "program": [str(find_program(config["program"]))],
        "interpreter": ["python"],
        "env": ["/usr/bin/env"],
        **arguments,
        **read_by_hydra,
    }
    return [
        str(word)
        for chunk in create_sweep_command(list(config["command"]))
        for word in macros.get(chunk[2:-1] if chunk.startswith("${") else "", [chunk])
    ]


def hydra_word(value: Any) -> str:
    """Format a parameter as a Hydra command-line word.

    A text is read as the text that it is, but for one that is a list or a mapping in brackets, as W&B's users write these.

    >>> hydra_word(None), hydra_word(True), hydra_word("true"), hydra_word("[dense,bac]")
    ('null', 'true', "'true'", '[dense,bac]')
    >>> hydra_word({"kind": "ddim", "timesteps": [87, 20]})
    "{kind: 'ddim', timesteps: [87, 20]}"
    """
    if not isinstance(value, str):
        return _written(value)
    read = _read_by_hydra(value)
    kept = isinstance(read, (list, dict)) if value[:1] in ("[", "{") else read == value
    return value if kept else _quoted(value)


def _read_by_hydra(text: str) -> Any:
    """Return what Hydra makes of a text after ``name=``; None if it reads nothing."""
    try:
        (override,) = OverridesParser.create().parse_overrides([f"name={text}"])
        return override.value()
    except HydraException:
        return None


def _written(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {_written(entry)}' for name, entry in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_written, value))}]"
    return _quoted(value) if isinstance(value, str) else str(value)


def _quoted(text: str) -> str:
    return QuotedString(text, Quote.single).with_quotes()


def find_program(name: str) -> Path:
    """Return the path of a sweep's program, looked up in the current folder, the package, and the folder beside it.

    >>> find_program("recipes/benchmark.py").name
    'benchmark.py'
    """
    package = Path(__file__).parents[1]
    # a wheel has the recipes in the package, a repository beside it
    folders = Path(), package, package.parent
    return next((folder / name for folder in folders if (folder / name).is_file()), Path(name))


def sweep_engine() -> Any:
    """Return wandb's own sweep engine, the package ``sweeps``."""
    try:
        import sweeps
        import sweeps.config.cfg
    except ImportError as error:
        raise ImportError(
            "a sweep without a server needs wandb's engine: pip install 'torchrl-sparse[sweeps]'"
        ) from error
    return sweeps
