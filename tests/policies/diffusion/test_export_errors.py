"""Files that are no exported policy: whatever is wrong, loading says so in one line."""

import ctypes
import re
import zlib

import pytest

from torchrl_sparse.blocks.engine.native.layout import Header
from torchrl_sparse.networks.diffusion.sampler import Sampler

from .test_export import SANITIZE_CPP, SANITIZED, SOURCES, make_policy, make_pruner, pytestmark, run

__all__ = ["pytestmark"]


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    """The C runtime as a library of its own, for any machine and quickly compiled."""
    path = tmp_path_factory.mktemp("tsp") / "libtsp.so"
    flags = ["-std=c++17", "-DPORTABLE_ONLY", "-shared", "-fPIC", *(SANITIZE_CPP if SANITIZED else ["-O1"])]
    run(["c++", *flags, SOURCES / "tsp.cpp", "-o", path], check=True)
    found = ctypes.CDLL(str(path))
    found.tsp_load.restype = found.tsp_load_memory.restype = ctypes.c_void_p
    found.tsp_free.argtypes = [ctypes.c_void_p]
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A small policy with every section that a file may have but a mask."""
    sizes = {"n_emb": 8, "n_layer": 1, "n_head": 2, "horizon": 2, "cond_dim": 1, "n_obs_steps": 1}
    policy = make_policy(Sampler("ddpm", 2), **sizes)
    policy.plan = make_pruner(policy, rate_input=True, hidden=4, width=4, obs_width=2)
    path = tmp_path_factory.mktemp("policy") / "policy.tsp"
    policy.export(path)
    return path.read_bytes()


def refusal(runtime, content):
    """Return why bytes are refused."""
    error = ctypes.create_string_buffer(200)
    assert (
        runtime.tsp_load_memory(content, ctypes.c_size_t(len(content)), error, ctypes.c_size_t(200)) is None
    )
    return error.value.decode()


def changed(whole, **fields):
    """Change fields of the header, and make the checksum good again."""
    header = Header.from_buffer_copy(whole)
    for name, value in fields.items():
        setattr(header, name, value)
    content = bytearray(bytes(header) + whole[ctypes.sizeof(header) :])
    content[12:16] = zlib.crc32(content[16:]).to_bytes(4, "little")
    return bytes(content)


def test_the_whole_file_is_taken(runtime, whole):
    policy = runtime.tsp_load_memory(whole, ctypes.c_size_t(len(whole)), None, ctypes.c_size_t(0))
    assert policy is not None
    runtime.tsp_free(policy)


def test_something_else_is_refused(runtime, whole):
    for content in (b"", b"TSPOLIC", b"x" * 200, b"tspolicy" + whole[8:]):
        assert refusal(runtime, content) == "expected an exported policy (.tsp)"
    newer = whole[:8] + (2).to_bytes(4, "little") + whole[12:]
    assert refusal(runtime, newer) == "version: expected 1, got 2; export the policy again"
    damaged = r"checksum: expected \w{8}, got \w{8}; the file is damaged"
    assert re.fullmatch(damaged, refusal(runtime, whole[:-1] + b"\x01"))


def test_a_truncated_file_is_refused_wherever_it_ends(runtime, whole):
    """Whether or not its header knows: each array begins on a cache line."""
    for size in (8, 9, 103):
        assert refusal(runtime, whole[:size]) == f"size: expected a header of 104 bytes, got {size}"
    for size in range(128, len(whole), 64):
        assert refusal(runtime, whole[:size]) == f"size: expected {len(whole)} bytes, got {size}"
        expected = f"size: expected the header's arrays to fill {size} bytes, got more"
        assert refusal(runtime, changed(whole[:size], size=size)) == expected
    longer = changed(whole + bytes(64), size=len(whole) + 64)
    assert refusal(runtime, longer) == (
        f"size: expected the header's arrays to fill {len(longer)} bytes, got fewer"
    )


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"horizon": 0}, "horizon: expected 1 to 1024, got 0"),
        ({"heads": 3}, "heads: expected a divisor of width 8, got 3"),
        ({"obs_steps": 3}, "obs_steps: expected 1 to 2, got 3"),
        ({"weights": 3}, "weights: expected 0 to 2, got 3"),
        ({"plan": 3}, "plan: expected 0 to 2, got 3"),
        ({"slots": 2}, "slots: expected 1, 3 or 3, got 2"),
        ({"pruned": 0}, "pruned: expected 1 to 2, got 0"),
        ({"description": -1}, "description: expected 0 to 1048576, got -1"),
    ],
)
def test_sizes_out_of_bounds_are_named(runtime, whole, fields, expected):
    assert refusal(runtime, changed(whole, **fields)) == expected


@pytest.mark.skipif(SANITIZED, reason="AddressSanitizer ends the process instead")
def test_memory_that_there_is_not_is_named(runtime):
    error, size = ctypes.create_string_buffer(200), 2**62
    assert runtime.tsp_load_memory(b"", ctypes.c_size_t(size), error, ctypes.c_size_t(200)) is None
    assert error.value.decode() == f"expected memory for {size} bytes, there is none"


def test_a_message_names_the_file_and_is_cut_where_it_does_not_fit(runtime, tmp_path, whole):
    (tmp_path / "cut.tsp").write_bytes(whole[:128])
    reasons = {
        "absent.tsp": "expected a file that can be read (No such file or directory)",
        ".": "expected a regular file",
        "cut.tsp": f"size: expected {len(whole)} bytes, got 128",
    }
    for name, reason in reasons.items():
        path = f"{tmp_path}/{name}"
        line = f"{path}: {reason}".encode()
        for size in (0, 1, 10, len(path) + 5, len(line), len(line) + 1):
            error = ctypes.create_string_buffer(b"#" * 500)
            assert runtime.tsp_load(path.encode(), error if size else None, ctypes.c_size_t(size)) is None
            if size:
                assert error.value == line[: size - 1]
            assert error.raw[size:] == (b"#" * 500 + b"\0")[size:]
