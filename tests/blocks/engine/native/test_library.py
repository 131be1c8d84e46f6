"""The compiled library: found, broken, missing; and what it depends on."""

import ctypes

import pytest

from torchrl_sparse.blocks.engine.native import library
from torchrl_sparse.blocks.engine.native.library import INSTRUCTION_SETS, native_available
from torchrl_sparse.blocks.engine.native.supports import native_supports

from .test_engine import SETS, make_network

AVAILABLE, REASON = native_available()
pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)


def test_a_missing_or_broken_library_is_a_reason_and_one_warning(tmp_path, monkeypatch):
    assert "was not built" in library._load(tmp_path)
    suffix = library.importlib.machinery.EXTENSION_SUFFIXES[0]
    (tmp_path / f"_native{suffix}").write_bytes(b"no library")
    assert "cannot be loaded" in library._load(tmp_path)

    monkeypatch.setattr(library, "_load", lambda _: "it was not built")
    library.library.cache_clear()
    try:
        with pytest.warns(UserWarning, match="without its native engine: it was not built"):
            assert native_available() == (False, "it was not built")
        assert native_supports(make_network()) == (False, "it was not built")
    finally:
        library.library.cache_clear()


def test_the_library_depends_on_nothing_but_the_c_runtime():
    """No PyTorch, no Python: any version of them can load it."""
    found = library.library()
    assert isinstance(found, ctypes.CDLL)
    with open(found._name, "rb") as file:
        content = file.read()
    assert not any(name in content for name in (b"libtorch", b"libc10", b"libpython"))
    assert set(SETS) <= set(INSTRUCTION_SETS)
