"""Every option of a recipe is changed, and what it names is seen to change.

A recipe's table has a row for each option of its yaml: another value, as a user types it, and what is seen of a run. Rows stand
in groups, and a group is one run that changes all of its options at once, so a recipe costs three or four small runs.
"""

from __future__ import annotations

import importlib
import inspect
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import hydra
import pytest
import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from tests.options.tasks import EASY
from tests.recipe_modules import load_recipe, options_file, script
from torchrl_sparse.envs.tasks import TASKS
from torchrl_sparse.storage.json import read_json

__all__ = ["AS_TYPED", "OTHER", "Call", "OptionTests", "Row", "Run", "Runs", "play", "returning"]

AS_TYPED = object()
OTHER = object()


@dataclass(frozen=True)
class Call:
    """A call of a function that a run makes: its arguments by name, what it returned, and PyTorch's threads then."""

    arguments: dict[str, Any]
    result: Any
    threads: int

    def __getitem__(self, name: str) -> Any:
        return self.arguments[name]


@dataclass
class Run:
    """What a run of a recipe left.

    Attributes:
        folder: in which it ran, and where what it began with lies.
        options: of it, all of them.
        printed: on stdout and stderr.
        calls: name of a watched function -> its calls.
    """

    folder: Path
    options: dict[str, Any]
    printed: str = ""
    calls: dict[str, list[Call]] = field(default_factory=dict)

    @property
    def out(self) -> Path:
        return self.folder / self.options["out"]

    def json(self, name: str) -> Any:
        return read_json(self.out / name, dict[str, Any])

    def names(self, pattern: str = "*") -> list[str]:
        """Names of the files in its output."""
        return sorted(path.name for path in self.out.glob(pattern))

    def call(self, name: str, index: int = 0) -> Call:
        assert self.calls.get(name), f"{name} was not called"
        return self.calls[name][index]


@dataclass(frozen=True)
class Row:
    """An option with another value, and what is seen of a run.

    Attributes:
        option: its name, nested ones with dots.
        value: as a user types it.
        seen: of a run, what the option names, and no other option of another group.
        expected: of the changed run: AS_TYPED is the value, and then the first run shows the default, where that is not null;
            OTHER is anything but what is seen of the runs that leave the option alone, which all see the same.
    """

    option: str
    value: str
    seen: Callable[[Run], Any]
    expected: Any = AS_TYPED


class OptionTests:
    """Tests of one recipe's options; a subclass says which and has the table.

    Attributes:
        recipe: its name, or ``studies.NAME``.
        base: options of every run that is not about them, most of which make it small.
        groups: of rows, each one run; a text among them is an option that its run needs beside its rows.
        watched: functions whose calls are recorded, by their names in the recipe's module or by their paths.
        replaced: the same, with what takes their places.
    """

    recipe: str
    base: Sequence[str] = ()
    groups: Sequence[Sequence[Row | str]]
    watched: Sequence[str] = ()
    replaced: Mapping[str, Callable] = {}

    @staticmethod
    def prepare(folder: Path) -> None:
        """Write into a run's folder what it begins with."""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        if "row" in metafunc.fixturenames:
            rows = [row for group in self.groups for row in _rows(group)]
            metafunc.parametrize("row", rows, ids=[f"{row.option}={row.value}" for row in rows])

    def test_every_option_has_its_row_and_every_row_its_option(self):
        named = [row.option for group in self.groups for row in _rows(group)]
        written = [*_leaves(_options(self.recipe))]
        entries = {option.rpartition(".")[0] for option in named}  # of sections that are open
        assert set(written) <= {*named, *entries}
        assert not [name for name in named if name not in written and name.rpartition(".")[0] not in written]

    def test_an_option_does_what_it_says(self, row, runs):
        index = next(number for number, group in enumerate(self.groups) if row in group)
        before, changed = row.seen(runs(None)), row.seen(runs(index))
        assert changed != before, f"{row.option}={row.value} changes nothing"
        if row.expected is OTHER:
            others = [
                n for n, group in enumerate(self.groups) if row.option not in {r.option for r in _rows(group)}
            ]
            assert all(row.seen(runs(other)) == before for other in others)
            return
        wanted = _read(row) if row.expected is AS_TYPED else row.expected
        assert changed == _near(wanted)
        default = OmegaConf.select(OmegaConf.create(runs(None).options), row.option)
        if row.expected is AS_TYPED and default is not None:
            assert before == _near(default)


class Runs:
    """The runs of a recipe: that of each group, or of none, is made when it is first asked for."""

    def __init__(self, tests: type[OptionTests], make_folder: Callable[[], Path]) -> None:
        self._tests, self._make_folder = tests, make_folder
        self._made: dict[int | None, Run | None] = {}

    def __call__(self, group: int | None) -> Run:
        if group not in self._made:
            self._made[group] = None  # one that fails is not tried again
            changes = () if group is None else self._tests.groups[group]
            words = [_word(self._tests.recipe, change) for change in changes]
            self._made[group] = play(self._tests, self._make_folder(), words)
        if (run := self._made[group]) is None:
            pytest.fail("the run failed, see the first test of it", pytrace=False)
        return run


def _rows(group: Sequence[Row | str]) -> list[Row]:
    return [row for row in group if isinstance(row, Row)]


def _near(value: Any) -> Any:
    return pytest.approx(value) if isinstance(value, float) else value


def _read(row: Row) -> Any:
    """The value of a row as Hydra reads it."""
    return OverridesParser.create().parse_override(f"{row.option}={row.value}").value()


def _word(recipe: str, row: Row | str) -> str:
    if isinstance(row, str):
        return row
    known = row.option in {*_leaves(_options(recipe)), *_options(recipe)}
    return f"{'' if known else '+'}{row.option}={row.value}"


@cache
def _options(recipe: str) -> dict[str, Any]:
    read = yaml.safe_load(options_file(recipe).read_text())
    return {name: value for name, value in read.items() if name not in ("defaults", "hydra")}


def _leaves(options: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in options.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def play(tests: type[OptionTests], folder: Path, changes: Sequence[str]) -> Run:
    """Run a recipe in this process as its program does, in a folder of its own."""
    module = load_recipe(tests.recipe)
    changed = {word.lstrip("+").partition("=")[0] for word in changes}
    words = [*(word for word in tests.base if word.lstrip("+").partition("=")[0] not in changed), *changes]
    calls: dict[str, list[Call]] = {}
    with _undone(folder), patch.dict(TASKS, {task.name: task for task in EASY}), ExitStack() as patches:
        tests.prepare(folder)
        for path in dict.fromkeys([*tests.watched, *tests.replaced]):
            owner, name = _find(module, path)
            found = tests.replaced.get(path, getattr(owner, name))
            noted = _noting(getattr(owner, name), found, calls.setdefault(path, []))
            patches.enter_context(patch.object(owner, name, noted))
        patches.enter_context(patch.object(sys, "argv", [str(script(tests.recipe)), *words]))
        printed = patches.enter_context(redirect_stdout(io.StringIO()))
        patches.enter_context(redirect_stderr(printed))
        module.main()
        options = _composed(tests.recipe, words)
    return Run(folder, options, printed.getvalue(), calls)


@contextmanager
def _undone(folder: Path) -> Iterator[None]:
    """Work in a folder; leave the process as it was."""
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    there = Path.cwd()
    with patch.dict(os.environ, HYDRA_FULL_ERROR="1", WANDB_MODE="offline", WANDB_SILENT="true"):
        os.chdir(folder)
        try:
            torch.set_num_threads(1)
            yield
        finally:
            os.chdir(there)
            torch.set_num_threads(threads)
            torch.set_rng_state(state)


def _find(module: Any, path: str) -> tuple[Any, str]:
    """Return the owner of what a path names, which is in the recipe's module or begins with a package, and its last word."""
    head, _, name = path.rpartition(".")
    if not head:
        return module, name
    try:
        return importlib.import_module(head), name
    except ModuleNotFoundError:  # of a class
        owner, _, word = head.rpartition(".")
        return getattr(importlib.import_module(owner) if owner else module, word), name


def _noting(original: Callable, function: Callable, calls: list[Call]) -> Callable:
    signature = inspect.signature(original)

    def noted(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        named = dict(bound.arguments)
        for name, parameter in signature.parameters.items():
            if parameter.kind is parameter.VAR_KEYWORD:
                named |= named.pop(name)
        threads = torch.get_num_threads()
        result = function(*args, **kwargs)
        calls.append(Call(named, result, threads))
        return result

    return noted


def _composed(recipe: str, words: Sequence[str]) -> dict[str, Any]:
    file = options_file(recipe)
    with hydra.initialize_config_dir(str(file.parent), version_base=None):
        config = hydra.compose(file.stem, overrides=list(words))
    return OmegaConf.to_container(config, resolve=True)


def returning(value: Any) -> Callable:
    """A function that takes anything and returns the value."""
    return partial(lambda value, *_, **__: value, value)
