"""``true`` where a number is meant, and 1 where ``true`` is: Python takes them for equal, files and options must not."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from tests.refusals import refused
from torchrl_sparse.blocks.uniform import Uniform
from torchrl_sparse.evaluation.results.realtime import load_realtime
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.storage.json import check_plain, parse_json

ASSETS = Path(__file__).parents[2] / "assets"


@dataclass(frozen=True)
class Mixed:
    version: Literal[1, 2]
    number: int
    share: float
    many: tuple[Literal[1, 2], ...] = ()
    flag: bool = False


def text(**entries):
    values = {"version": "1", "number": "3", "share": "0.5"} | entries
    return "{" + ", ".join(f'"{name}": {value}' for name, value in values.items()) + "}"


def test_numbers_and_booleans_that_are_such_are_read():
    assert parse_json(text(many="[1, 2]", flag="true"), Mixed, "f") == Mixed(1, 3, 0.5, (1, 2), True)
    assert parse_json(text(share="1"), Mixed, "f").share == 1.0


@pytest.mark.parametrize(
    ("name", "value", "got"),
    [
        ("version", "true", "True"),
        ("version", "1.0", "1.0"),
        ("number", "true", "True"),
        ("number", "3.0", "3.0"),
        ("number", '"3"', "'3'"),
        ("share", "true", "True"),
        ("share", '"0.5"', "'0.5'"),
        ("many", "[1, true]", "True"),
        ("flag", "1", "1"),
        ("flag", '"true"', "'true'"),
    ],
)
def test_another_kind_is_refused_by_name(name, value, got):
    """pydantic, however strict, takes ``true`` and ``1.0`` for a `Literal` of 1."""
    with refused("f: many.1" if name == "many" else f"f: {name}") as error:
        parse_json(text(**{name: value}), Mixed, "f")
    assert str(error.value).endswith(f"got {got}")


@pytest.mark.parametrize(
    ("file", "load", "entry"),
    [
        ("lift/realtime.json", load_realtime, '"realtime": 2'),
        ("lift/results.json", load_results, '"schema": 2'),
    ],
)
def test_a_version_that_is_true_is_no_version(tmp_path, file, load, entry):
    """A ``realtime.json`` with ``"realtime": true`` was read as one of version 1."""
    content = (ASSETS / file).read_text()
    assert entry in content
    for wrong in ("true", "2.0"):
        path = tmp_path / "damaged.json"
        path.write_text(content.replace(entry, f"{entry.rpartition(' ')[0]} {wrong}"))
        with refused(f"damaged.json: {entry.split(chr(34))[1]}"):
            load(path)


def test_options_and_arguments_take_no_boolean_for_a_number():
    with refused("version"):
        check_plain(True, Literal[1], "version")
    with refused("interval"):
        Uniform(True)
