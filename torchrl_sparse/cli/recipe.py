"""Decorator of every recipe: Hydra reads the options, which are checked; the output is locked; errors take one line."""

from __future__ import annotations

import gc
import inspect
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import wraps
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import hydra
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_sparse.cli.options import OPTIONS, check_options
from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.runtime.lock import lock_output
from torchrl_sparse.runtime.names import closest

__all__ = ["benchmark_command", "check_command", "recipe", "refuse_unread"]

_FULL = "HYDRA_FULL_ERROR"
_MISTAKES = (ValueError, OSError, ImportError, HydraException, OmegaConfBaseException, RunFailed)


def recipe(
    name: str,
    *,
    out: Literal["folder", "file"] | None = "folder",
    options: Mapping[str, Any] | None = None,
    positional: str | None = None,
) -> Callable:
    """Turn a function of options into a program whose options are listed in ``name.yaml`` beside its file.

    A mistake (`ValueError`, `OSError`, `ImportError`, or one that Hydra finds) or `RunFailed` ends it with exit code 2 and one
    line on stderr; the environment variable ``HYDRA_FULL_ERROR=1`` shows the whole traceback instead. All options are checked
    before the function is called, see `check_options`, and no other recipe works on the same ``out`` while it runs.

    Args:
        name: of the recipe.
        out: what the option ``out`` names; None if the recipe has none, or locks it itself.
        options: option -> type, of options that no recipe of the library has, as a study's own.
        positional: option, a list, that takes the words of the command line that are no options: paths.
    """
    table = OPTIONS | dict(options or {})

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        folder = Path(inspect.getfile(main)).resolve().parent

        @wraps(main)
        def run() -> None:
            if {"--help", "-h"} & {*sys.argv[1:]}:
                print(_help(inspect.getmodule(main).__doc__ or "", folder / f"{name}.yaml"))
                return
            gc.freeze()  # robosuite collects garbage whenever a simulator closes, and what was imported never is any
            with _one_line_errors():
                for config in _read_options(folder, name, positional):
                    check_options(
                        name, OmegaConf.to_container(config, resolve=True, throw_on_missing=True), table
                    )
                    with lock_output(config.out, is_file=out == "file") if out else nullcontext():
                        main(config)

        return run

    return decorate


def benchmark_command(task: str, policy: str, planners: str | Path, methods: Sequence[str]) -> str:
    """Return the command that compares the new policy or planner with dense.

    >>> benchmark_command("lift", "runs/lift/policy", "runs/sag", ["pruner"])
    'next: torchrl-sparse benchmark task=lift policy=runs/lift/policy planners=runs/sag methods=[dense,pruner]'
    """
    names = ",".join(["dense", *methods])
    return f"next: torchrl-sparse benchmark task={task} policy={policy} planners={planners} methods=[{names}]"


def check_command(program: Path, words: Sequence[str]) -> None:
    """Read and check another recipe's command line as that recipe would, without running it.

    Args:
        program: path of the recipe; a program without a yaml of options beside it is none, and nothing is checked.
        words: of the command line, after the program.

    Raises:
        InputError: in one line, for the first word that the recipe would refuse.
    """
    options = program.resolve().with_suffix(".yaml")
    if not options.is_file():
        return
    try:
        with hydra.initialize_config_dir(str(options.parent), version_base=None):
            config = hydra.compose(options.stem, overrides=list(words))
        check_options(options.stem, OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        raise InputError(_one_line(error)) from error


def refuse_unread(config: DictConfig, names: Sequence[str], program: str, why: str) -> None:
    """Raise InputError for the first of the options ``names`` that is set although nothing would read it.

    Args:
        config: of a recipe.
        names: options that have to be as its yaml says.
        program: path of the recipe, beside which the yaml lies.
        why: ends what is expected, such as "of a VLA".
    """
    defaults = OmegaConf.load(Path(program).with_suffix(".yaml"))
    for name in names:
        if config[name] != defaults[name]:
            expected = "null" if defaults[name] is None else defaults[name]
            raise InputError(f"{name}: expected {expected} {why}, got {config[name]}")


def _help(purpose: str, options: Path) -> str:
    """Return a recipe's description and its commented YAML without Hydra's own section."""
    text = options.read_text(encoding="utf-8").rpartition("- _self_")[2].partition("\nhydra:")[0]
    return f"{purpose.strip()}\n\n{text.strip()}"


def _read_options(folder: Path, name: str, positional: str | None) -> list[DictConfig]:
    """Return the options of this command line: one set, or several of ``--multirun``."""
    read: list[DictConfig] = []
    words = [*sys.argv] if positional is None else [sys.argv[0], *_name_paths(sys.argv[1:], positional)]

    def note(config: DictConfig) -> None:
        read.append(config)

    with (
        patch.dict(os.environ, {_FULL: "1"}),
        patch.object(sys, "argv", words),
    ):  # so that Hydra raises its errors instead of printing them
        hydra.main(version_base=None, config_path=str(folder), config_name=name)(note)()
    for (
        logger
    ) in logging.root.manager.loggerDict.values():  # Hydra's setting has switched off those that were there
        if isinstance(logger, logging.Logger) and logger.name.startswith("torchrl_sparse"):
            logger.disabled = False
    return read


def _name_paths(words: Sequence[str], option: str) -> list[str]:
    """Make of the words that are no options one option, a list of them; a path with an equals sign is one if it is there.

    >>> _name_paths(["a.json", "margin=0.1", "b c.csv"], "files")
    ['margin=0.1', "files=['a.json','b c.csv']"]
    """
    paths = [word for word in words if not word.startswith("-") and ("=" not in word or Path(word).exists())]
    rest = [word for word in words if word not in paths]
    if not paths:
        return rest
    if any(word.startswith(f"{option}=") for word in rest):
        raise InputError(f"{option}: expected paths as words or as {option}=[…], got both")
    quoted = (QuotedString(path, Quote.single).with_quotes() for path in paths)
    return [*rest, f"{option}=[{','.join(quoted)}]"]


@contextmanager
def _one_line_errors() -> Iterator[None]:
    if os.environ.get(_FULL, "0") != "0":
        yield
        return
    try:
        yield
    except _MISTAKES as error:
        print(_one_line(error), file=sys.stderr)
        sys.exit(2)


def _one_line(error: Exception) -> str:
    """Say what is wrong in one line; what follows an empty one, such as the traceback of a worker, is left out."""
    unknown = getattr(error.__cause__, "full_key", None)
    if isinstance(error, HydraException) and unknown:
        words = error.__cause__.parent_node
        close = closest(unknown.rpartition(".")[2], map(str, words or ()))
        return f"{unknown}: expected an option of this recipe{f', such as {close}' if close else ''}, got another"
    missing = getattr(error, "full_key", None)
    if isinstance(error, OmegaConfBaseException) and missing:
        return f"{missing}: expected a value, got {str(error).splitlines()[0]}"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).partition("\n\n")[0].split()) or type(error).__name__
