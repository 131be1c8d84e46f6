"""Lets `make sanitize` put its own build of the native engine under the tests."""

import ctypes
import os

from torchrl_sparse.blocks.engine.native import library, packing

SANITIZED = os.environ.get("SANITIZED_NATIVE")
if SANITIZED:
    library._load = lambda _: library._declare(ctypes.CDLL(SANITIZED))
    # Every array in memory of its own, from malloc: the sanitizer then sees reads beyond each of them.
    packing.Arena._BLOCK = 0
    packing._pages = bytearray
