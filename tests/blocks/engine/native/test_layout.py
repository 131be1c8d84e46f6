"""What Python and compiled code share: both describe it alike, or say so."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from torchrl_sparse.blocks.engine.native import layout, library
from torchrl_sparse.blocks.engine.native.library import native_available

AVAILABLE, REASON = native_available()
SOURCES = Path(layout.__file__).parent
PROGRAM = """
#include <stdio.h>
#include "structs.h"
int main() { printf("%llu", (unsigned long long)layout_hash()); }
"""


def compiled_hash(folder, description):
    (folder / "layout.h").write_text(description)
    shutil.copy(SOURCES / "structs.h", folder)
    (folder / "hash.cpp").write_text(PROGRAM)
    subprocess.run(["c++", "-std=c++17", folder / "hash.cpp", "-o", folder / "hash"], check=True)
    return int(subprocess.run([folder / "hash"], capture_output=True, check=True).stdout)


@pytest.mark.skipif(not shutil.which("c++"), reason="no compiler")
def test_both_sides_hash_alike_and_every_difference_counts(tmp_path):
    written = (SOURCES / "layout.h").read_text()
    assert compiled_hash(tmp_path, written) == layout.layout_hash()
    seen = {layout.layout_hash()}
    for before, after in (
        ("CONSTANT(PANEL, 32)", "CONSTANT(PANEL, 16)"),
        ('"TSPOLICY"', '"TSPOLICX"'),
        ("FIELD(int32_t, rows)\nFIELD(int32_t, columns)", "FIELD(int32_t, columns)\nFIELD(int32_t, rows)"),
        (
            "FIELD(float, clip)\nFIELD(const Layer*, layer)",
            "FIELD(int32_t, clip)\nFIELD(const Layer*, layer)",
        ),
        ("FIELD(int32_t, count)", "FIELD(uint64_t, count)"),
        ("FIELD(const float*, valid)", "FIELD(const float*, mask)"),
    ):
        assert before in written
        seen.add(compiled_hash(tmp_path, written.replace(before, after, 1)))
    assert len(seen) == 7


def test_the_hash_is_of_where_the_fields_are(monkeypatch):
    class Units(ctypes.Structure):
        _fields_ = (*reversed(layout.Units._fields_),)

    expected = layout.layout_hash()
    monkeypatch.setitem(layout._TYPES, "Units", Units)
    assert layout.layout_hash() != expected


@pytest.mark.skipif(not AVAILABLE, reason=REASON)
@pytest.mark.parametrize("name", ["INTERFACE", "PANEL"])
def test_a_library_of_another_description_is_refused(monkeypatch, name):
    """Its structures would be read wrongly and its functions called with other arguments, without a word."""
    monkeypatch.setitem(layout.CONSTANTS, name, 1)
    reason = library._load(SOURCES)
    assert re.fullmatch(
        r"_native\S* was built from other sources than .*; build it again: pip install -e \.", reason
    )


@pytest.mark.skipif(not AVAILABLE, reason=REASON)
def test_a_library_from_before_the_description_is_refused(monkeypatch):
    monkeypatch.setitem(library._SIGNATURES, "sparse_later", (None, []))
    assert "was built from other sources" in library._load(SOURCES)
