"""Reader of pickles as data: their content is returned, and code that they ask to run is refused.

A pickle is a program for a small stack machine, and Python's own machine imports and calls whatever the
program names. This one has no operation that imports, and calls nothing but the few functions that the
reader of a format hands in, each known by the name that a pickle gives it.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_sparse.errors import InputError

__all__ = ["PLAIN", "Name", "Record", "read_pickle"]

_KEYS = (str, int, float, bytes, type(None))
_MAX_OPERATIONS = 1_000_000  # the tensors of the largest published policies take a quarter
_MAX_BITS = 64


@dataclass(frozen=True)
class Name:
    """A dotted name mentioned in a pickle; never imported or looked up."""

    path: str


@dataclass
class Record:
    """Stand-in for an object whose class is never instantiated: the fields of its state."""

    name: str
    state: dict = field(default_factory=dict)


def _encode(text: str, encoding: str) -> bytes:
    """Decode bytes as protocol 2 spells them."""
    if encoding != "latin1":
        raise InputError(f"expected bytes spelled in latin1, got {encoding!r}")
    return text.encode("latin1")


PLAIN: dict[str, Callable[..., Any] | None] = {
    "collections.OrderedDict": lambda: {},
    "collections.defaultdict": lambda default: {},
    "_codecs.encode": _encode,
}
"""Containers, which pickles make empty and fill later, and bytes; for `read_pickle`."""


def read_pickle(
    data: bytes,
    known: Mapping[str, Callable[..., Any] | None] = PLAIN,
    persistent: Callable[[Any], Any] | None = None,
) -> Any:
    """Read the object described by a pickle, built from plain containers and the constructors in ``known``.

    Args:
        data: the pickle, of any protocol.
        known: the only names that the pickle may mention, each with the function that makes an object from
            the arguments found there; None for names that may be mentioned and not called.
        persistent: makes an object of a persistent id; without it there may be none.

    Raises:
        InputError: if the pickle is damaged, mentions another name, needs any other operation or more than a million, or
            makes whole numbers of more than 64 bits or more bytes than it has itself.

    Examples:
        >>> import pickle
        >>> read_pickle(pickle.dumps({"epoch": 3, "name": [b"x", None]}))
        {'epoch': 3, 'name': [b'x', None]}
        >>> read_pickle(pickle.dumps(print))
        Traceback (most recent call last):
            ...
        torchrl_sparse.errors.InputError: expected plain data, got a pickle that asks for builtins.print
    """
    machine = _Machine(known, persistent, len(data))
    try:
        for number, operation in enumerate(_operations(data)):
            if number == _MAX_OPERATIONS:
                raise InputError(
                    f"expected a pickle of at most {_MAX_OPERATIONS} operations, got a longer one"
                )
            machine.execute(*operation)
        return machine.result()
    except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
        # A damaged program underflows the stack, or applies operations to values that do not have them.
        raise InputError(f"expected a complete pickle, got a damaged one: {error}") from error


def _operations(data: bytes) -> Iterator[tuple[str, Any]]:
    try:
        for opcode, argument, _ in pickletools.genops(data):
            yield opcode.name, argument
    except ValueError as error:
        raise InputError(f"expected a complete pickle, got a damaged one: {error}") from error


class _Machine:
    """Stack, marks and memo of one pickle, and how many bytes it may still make."""

    def __init__(self, known: Mapping, persistent: Callable | None, room: int) -> None:
        self._known, self._persistent, self._room = known, persistent, room
        self._stack: list[Any] = []
        self._below_marks: list[list[Any]] = []
        self._memo: dict[int, Any] = {}

    def execute(self, opcode: str, argument: Any) -> None:
        if opcode in _CONSTANTS:
            self._push(_CONSTANTS[opcode])
        elif opcode in _LITERALS:
            self._push_literal(argument)
        elif opcode in _STORES:
            self._memo[len(self._memo) if argument is None else argument] = self._stack[-1]
        elif opcode in _FETCHES:
            self._push(self._memo[argument])
        elif opcode in _OPERATIONS:
            _OPERATIONS[opcode](self, argument)
        elif opcode not in _NOTHING:
            raise InputError(f"expected plain data, got a pickle with the operation {opcode}")

    def result(self) -> Any:
        if len(self._stack) != 1 or self._below_marks:
            raise InputError("expected a complete pickle, got one that leaves values over")
        return self._stack[0]

    def _pop(self, count: int) -> tuple:
        values = tuple(self._stack[len(self._stack) - count :])
        if len(values) < count:
            raise LookupError("stack underflow")
        del self._stack[len(self._stack) - count :]
        return values

    def _pop_to_mark(self) -> list[Any]:
        values, self._stack = self._stack, self._below_marks.pop()
        return values

    def _mark(self, _: Any) -> None:
        self._below_marks.append(self._stack)
        self._stack = []

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _push_literal(self, value: Any) -> None:
        if isinstance(value, int) and value.bit_length() > _MAX_BITS:
            raise InputError(
                f"expected whole numbers of at most {_MAX_BITS} bits, got one of {value.bit_length()}"
            )
        self._push(value)

    def _extend(self, items: list[Any]) -> None:
        if not isinstance(self._stack[-1], list):
            raise InputError(f"expected a list to append to, got {type(self._stack[-1]).__name__}")
        self._stack[-1].extend(items)

    def _update(self, items: list[Any]) -> None:
        target, keys = self._stack[-1], items[::2]
        if not isinstance(target, dict) or len(items) % 2:
            raise InputError(f"expected pairs for a dict, got {len(items)} for {type(target).__name__}")
        for key in keys:
            if not isinstance(key, _KEYS):  # hashing anything else could run deep into a nested value
                raise InputError(f"expected plain keys of a dict, got {type(key).__name__}")
        target.update(zip(keys, items[1::2], strict=True))

    def _name(self, path: str) -> None:
        if path not in self._known:
            raise InputError(f"expected plain data, got a pickle that asks for {path}")
        self._push(Name(path))

    def _stack_name(self) -> None:
        module, name = self._pop(2)
        self._name(f"{module}.{name}")

    def _make(self) -> None:
        name, arguments = self._pop(2)
        make = self._known.get(name.path) if isinstance(name, Name) else None
        if make is None or not isinstance(arguments, tuple):
            raise InputError(
                f"expected plain data, got a pickle that calls {getattr(name, 'path', 'a value')}"
            )
        made = make(*arguments)
        if isinstance(
            made, bytes
        ):  # of one string that it remembers, a pickle could have them made again and again
            self._room -= len(made)
            if self._room < 0:
                raise InputError("expected plain data, got a pickle that makes more bytes than it has")
        self._push(made)

    def _set_state(self) -> None:
        (state,) = self._pop(1)
        target = self._stack[-1]
        if isinstance(target, Record) and isinstance(state, dict):
            target.state = state
        elif not isinstance(target, dict):  # the attributes of a state dict are its modules' versions
            raise InputError(f"expected plain data, got a pickle that changes a {type(target).__name__}")

    def _push_persistent(self) -> None:
        (identity,) = self._pop(1)
        if self._persistent is None:
            raise InputError("expected plain data, got a pickle that refers to storages")
        self._push(self._persistent(identity))


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = {
    *("INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
}
_STORES = {"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"}
_FETCHES = {"GET", "BINGET", "LONG_BINGET"}
_NOTHING = {"PROTO", "FRAME", "STOP"}
_OPERATIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "EMPTY_DICT": lambda machine, _: machine._push({}),
    "EMPTY_LIST": lambda machine, _: machine._push([]),
    "MARK": _Machine._mark,
    "TUPLE": lambda machine, _: machine._push(tuple(machine._pop_to_mark())),
    "TUPLE1": lambda machine, _: machine._push(machine._pop(1)),
    "TUPLE2": lambda machine, _: machine._push(machine._pop(2)),
    "TUPLE3": lambda machine, _: machine._push(machine._pop(3)),
    "APPEND": lambda machine, _: machine._extend(list(machine._pop(1))),
    "APPENDS": lambda machine, _: machine._extend(machine._pop_to_mark()),
    "SETITEM": lambda machine, _: machine._update(list(machine._pop(2))),
    "SETITEMS": lambda machine, _: machine._update(machine._pop_to_mark()),
    "GLOBAL": lambda machine, argument: machine._name(argument.replace(" ", ".", 1)),
    "STACK_GLOBAL": lambda machine, _: machine._stack_name(),
    "REDUCE": lambda machine, _: machine._make(),
    "NEWOBJ": lambda machine, _: machine._make(),
    "BUILD": lambda machine, _: machine._set_state(),
    "BINPERSID": lambda machine, _: machine._push_persistent(),
}
