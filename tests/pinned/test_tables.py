"""The committed results and episodes give the tables that they gave when `tests.pinned.record` was last run."""

import pytest

from tests.pinned import tables
from tests.pinned.record import load_tables

NAMES = [*tables.names()]


@pytest.fixture(scope="module")
def stored():
    return load_tables()


def test_what_is_committed_is_pinned(stored):
    assert set(NAMES) == stored.keys()


@pytest.mark.parametrize("name", NAMES)
def test_tables_stay(name, stored):
    assert tables.table(name) == stored[name]
