"""Messages go through whole; whatever else comes is refused in a line, and fills no memory."""

import tracemalloc
from contextlib import suppress

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.errors import InputError
from torchrl_sparse.serving.messages import pack, unpack

msgpack = pytest.importorskip("msgpack")

ARRAY = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f4", b"shape": (2,)}
SCALAR = {b"__npgeneric__": True, b"data": 1, b"dtype": "<i8"}


@pytest.mark.parametrize("dtype", ["bool", "u1", "i8", "f2", "f4", ">f8"])
@pytest.mark.parametrize("shape", [(), (0,), (2, 3, 4)])
def test_arrays_come_back_as_they_are(dtype, shape):
    array = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    back = unpack(pack({"observation": {"state": array}, "prompt": "lift"}))
    assert back["prompt"] == "lift"
    np.testing.assert_array_equal(back["observation"]["state"], array, strict=True)


def test_scalars_of_numpy_come_back():
    assert unpack(pack({"step": np.int64(3), "rate": np.float32(0.5)})) == {"step": 3, "rate": 0.5}
    assert unpack(msgpack.packb({**SCALAR, b"data": "lift", b"dtype": "<U4"})) == "lift"


@pytest.mark.parametrize(
    "dtype", ["O", "|O", "V8", "<c8", "<M8[s]", "U2", "S2", "f4,f4", "<f16", "(1000000000,)f4", 7, None, "x"]
)
def test_other_dtypes_are_refused(dtype):
    with refused("dtype"):
        unpack(msgpack.packb({**ARRAY, b"dtype": dtype}))


@pytest.mark.parametrize(
    ("entry", "changes"),
    [
        ("data", {b"shape": (3,)}),
        ("data", {b"shape": (2**40, 2**40)}),
        ("data", {b"data": "text"}),
        ("data", {b"data": bytes(9)}),
        ("data", {b"shape": ()}),
        ("shape", {b"shape": (-2,)}),
        ("shape", {b"shape": (-1, -2)}),
        ("shape", {b"shape": (1,) * 9}),
        ("shape", {b"shape": (2.0,)}),
        ("shape", {b"shape": (True, 2)}),
        ("shape", {b"shape": None}),
    ],
)
def test_sizes_have_to_match(entry, changes):
    with refused(entry):
        unpack(msgpack.packb(ARRAY | changes))


@pytest.mark.parametrize(
    "changes",
    [{b"data": 300, b"dtype": "u1"}, {b"data": "1"}, {b"dtype": "O"}, {b"data": None}, {b"data": [1]}],
)
def test_scalars_have_to_fit(changes):
    with refused("dtype"):
        unpack(msgpack.packb(SCALAR | changes))


@pytest.mark.parametrize(
    "message",
    [
        "text", b"", b"\xc1", b"no map at all", msgpack.packb({"a": 1})[:-1], msgpack.packb(1) + b"\x00",
        b"\x91" * 5000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", msgpack.packb(msgpack.ExtType(5, b"x")),
        msgpack.packb(msgpack.Timestamp(1)), msgpack.packb({1: 2}), b"\xa2\xff\xff", msgpack.packb([[]] * 1000),
    ],
)  # fmt: skip
def test_what_is_no_message_is_refused(message):
    with refused("message"):
        unpack(message)


@pytest.mark.parametrize(
    "unit", [b"\x90", b"\x80", b"\xc0", b"\xdc\x04\x00" + b"\xc0" * 1024], ids=["list", "map", "nil", "long"]
)
def test_a_short_message_fills_no_memory(unit):
    message = b"\xdc\x03\xff" + unit * 1023
    message += message * 200
    tracemalloc.start()
    try:
        with refused("message"):
            unpack(message)
        assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    finally:
        tracemalloc.stop()


def test_any_change_of_a_byte_is_read_or_refused():
    whole = pack({"observation/state": np.arange(3.0), "episode": {"seed": np.int64(3), "reset": True}})
    for place in range(len(whole)):
        for value in (0, 0x7F, 0x80, 0xC1, 0xFF, whole[place] ^ 1):
            with suppress(InputError):
                unpack(whole[:place] + bytes([value]) + whole[place + 1 :])
