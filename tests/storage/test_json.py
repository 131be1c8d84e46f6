"""The one reader and writer of JSON: what it refuses, and in which words."""

from dataclasses import dataclass
from typing import Any, Literal

import pytest

from tests.refusals import refused
from torchrl_sparse.storage import json as strict
from torchrl_sparse.storage.json import parse_json, read_json, to_plain, write_json


@dataclass(frozen=True)
class Rate:
    k: int
    ci95: tuple[float, float]

    def __post_init__(self) -> None:
        if self.k < 0:
            raise ValueError(f"k: expected at least 0, got {self.k}")


@dataclass(frozen=True)
class Table:
    format: Literal["table/1"]
    rates: dict[str, Rate]
    settings: dict[str, Any]
    note: str | None = None


TABLE = Table("table/1", {"dense": Rate(3, (0.1, 0.9))}, {"tried": [1, 2]})


def table(rate: str = '{"k": 1, "ci95": [0, 1]}', settings: str = "{}", name: str = "table/1") -> str:
    return f'{{"format": "{name}", "rates": {{"a": {rate}}}, "settings": {settings}}}'


def test_what_was_written_is_read(tmp_path):
    file = write_json(tmp_path / "new" / "table.json", TABLE)
    assert read_json(file, Table) == TABLE
    assert "note" not in file.read_text()


def test_a_field_without_a_default_is_written_where_it_is_none():
    @dataclass(frozen=True)
    class Kept:
        fine: float | None

    assert to_plain(Kept(None)) == {"fine": None}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "f.json: expected an object, got []"),
        (table(name="table/2"), "f.json: format: expected 'table/1', got 'table/2'"),
        (table('{"k": 1}'), "f.json: rates.a.ci95: expected this key, got nothing"),
        (table('{"k": 1, "ci95": [0, 1], "n": 2}'), "f.json: rates.a.n: expected no such key, got 2"),
        (table('{"k": 1.0, "ci95": [0, 1]}'), "f.json: rates.a.k: expected a valid integer, got 1.0"),
        (table('{"k": true, "ci95": [0, 1]}'), "f.json: rates.a.k: expected a valid integer, got True"),
        (table('{"k": 1, "ci95": [0, "1"]}'), "f.json: rates.a.ci95.1: expected a valid number, got '1'"),
        (table('{"k": 1, "ci95": [0, 1e999]}'), "f.json: rates.a.ci95.1: expected a finite number, got inf"),
        (
            table(settings='{"tried": [1, 1e999]}'),
            "f.json: tried: expected finite numbers, got one beyond floats",
        ),
        (table(settings='{"a": 1, "b": 2, "a": 3}'), "f.json: a: expected one entry of this name, got 2"),
        (table('{"k": 1, "ci95": [0, 1], "k": 1}'), "f.json: k: expected one entry of this name, got 2"),
        (table('{"k": -1, "ci95": [0, 1]}'), "f.json: rates.a.k: expected at least 0, got -1"),
    ],
)
def test_a_fault_is_named_with_file_and_key(tmp_path, text, message):
    file = tmp_path / "f.json"
    file.write_text(text)
    with refused(message.partition(": expected ")[0]) as error:
        read_json(file, Table)
    assert str(error.value) == f"{tmp_path}/{message}"


@pytest.mark.parametrize("text", ["", '{"a":', '{"a": NaN}', "\x00", b"\xff\xfe"])
def test_what_is_no_json_is_refused(text):
    with refused("line 7"):
        parse_json(text, Any, "line 7")


@pytest.mark.parametrize("settings", ["[" * 100_000, '{"a":' * 100_000])
def test_a_deep_file_is_refused_by_name(settings):
    with refused("deep"):
        parse_json(table(settings=settings), Table, "deep")


def test_a_huge_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    file = write_json(tmp_path / "table.json", TABLE)
    monkeypatch.setattr(strict, "MAX_BYTES", 10)
    with refused("table.json"):
        read_json(file, Table)


def test_a_missing_file_is_named(tmp_path):
    with refused("none.json", FileNotFoundError):
        read_json(tmp_path / "none.json", Table)


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (Table("table/2", {}, {}), ValueError),
        (Table("table/1", {}, {"rate": float("nan")}), ValueError),
        (Table("table/1", {}, {"rate": object()}), TypeError),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path, value, kind):
    with pytest.raises(kind, match=r"table\.json: "):
        write_json(tmp_path / "table.json", value)
    assert not list(tmp_path.iterdir())


def test_a_long_value_is_cut_short_in_the_message():
    with refused("f: rates.a") as error:
        parse_json(table(f'"{"x" * 10_000}"'), Table, "f")
    assert len(str(error.value)) < 200
