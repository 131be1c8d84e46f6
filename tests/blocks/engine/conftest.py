"""Lets `make sanitize` put its own build of the native engine under the tests."""

import ctypes
import os

from torchrl_sparse.blocks.engine.native import arena, library

SANITIZED = os.environ.get("SANITIZED_NATIVE")
if SANITIZED:
    library._load = lambda _: library._declare(ctypes.CDLL(SANITIZED))
    # Every array in memory of its own, from malloc: the sanitizer then sees reads beyond each of them.
    arena.Arena._BLOCK = 0
    arena._pages = bytearray
