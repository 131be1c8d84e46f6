"""What CPython and PyTorch keep of weights in memory, looked at in one call.

Python takes 0.05 ms to ask 158 parameters for their addresses, layouts and versions, and some three times as long where a query
has driven all that it goes through out of the caches. Each of them is a word somewhere behind the parameter, and a dictionary
counts its changes in another. Compiled code asks the caches for all these words at once and compares them.

Where they lie, neither project promises. So `layout_is_known` tries it, once in a process: a small module is changed in each
way that a :class:`~torchrl_sparse.blocks.engine.weights.WeightWatch` sees, and only if every change is seen here too may this
be relied on. Pointers are followed only from objects that are held, and only as long as they are what they were.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Sequence
from ctypes import c_uint64, c_void_p
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sparse.blocks.engine.native.library import loaded
from torchrl_sparse.blocks.engine.weights import Members

__all__ = ["Kept", "addresses", "layout_is_known"]

_WORD = ctypes.sizeof(c_void_p)
_WORDS = 21  # of a parameter, PARAMETER_WORDS of native.cpp


class Kept:
    """What is kept of a network's members at the time when this is made; only where `layout_is_known`.

    Args:
        members: of a network; they are held.
        begins: where the values of each parameter are thought to begin.
        values: addresses of some of them, f32, which are compared too.
    """

    def __init__(self, members: Members, begins: Sequence[int], values: ctypes.Array) -> None:
        self.members, self.values = members, values
        objects, holders = (addresses(map(id, part)) for part in (members.parameters, members.holders))
        words = (c_uint64 * (_WORDS * len(objects) + len(holders) + len(values)))()
        counts = len(objects), objects, len(holders), holders, len(values), values
        self._query = _place_of_tensor(), *counts, words
        self._recorded = bool(_compare()(addresses(begins), *self._query))

    def is_same(self) -> bool:
        """Tell whether nothing has changed since, nor had before: values that begin elsewhere may lie nowhere any more."""
        return self._recorded and bool(_compare()(None, *self._query))


def addresses(places: Iterable[int]) -> ctypes.Array:
    """Return an array of pointers."""
    places = list(places)
    return (c_void_p * len(places))(*places)


@lru_cache(maxsize=1)
def _compare() -> Callable[..., int]:
    # A prototype that keeps the interpreter's lock: nothing in Python may change meanwhile.
    found: Any = loaded()
    function = found.sparse_kept
    return ctypes.PYFUNCTYPE(function.restype, *function.argtypes)((function.__name__, found))


# -- trying it -----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def layout_is_known() -> bool:
    """Return whether `Kept` sees here what it has to see, and nothing where nothing changed."""
    # Whoever asks first may do so in inference mode, whose tensors count no versions.
    with torch.inference_mode(False):
        return all(map(_sees, _CHANGES))


def _sees(change: Callable[[nn.Module], None]) -> bool:
    module = nn.Module()
    module.weight = nn.Parameter(_zeros(12)[3:].view(3, 3))
    if not _points_as_expected(module.weight):
        return False
    begins = [module.weight.data_ptr()]
    before = Kept(Members.of(module), begins, addresses(begins))
    module.weight.sum()
    undisturbed = before.is_same()
    with torch.no_grad():
        change(module)
    return undisturbed and not before.is_same()


def _points_as_expected(parameter: nn.Parameter) -> bool:
    """Return whether words that will be followed are pointers; a version is shared with a view and nothing else."""
    view, other = parameter.detach(), _zeros(1)
    storage, *_, version = _words(parameter._cdata, 2, 6)
    of_view, of_other = (_words(tensor._cdata, 5, 6)[0] for tensor in (view, other))
    follows = _place_of_tensor() is not None and storage == parameter.untyped_storage()._cdata
    return follows and version == of_view != of_other


@lru_cache(maxsize=1)
def _place_of_tensor() -> int | None:
    """Return which word of a tensor's Python object points to the tensor: its first own one, or the second in older PyTorch."""
    tensor = _zeros(1)
    words = _words(id(tensor), 2, 4)
    return 2 + words.index(tensor._cdata) if tensor._cdata in words else None


def _words(place: int, first: int, last: int) -> list[int]:
    """Return words of an object that is alive and not smaller than that."""
    return [c_uint64.from_address(place + _WORD * i).value for i in range(first, last)]


def _zeros(*shape: int) -> Tensor:
    """Return such weights, whatever the type and the device by default."""
    return torch.zeros(shape, dtype=torch.float32, device="cpu")


def _shift(module: nn.Module) -> None:
    """Move a parameter within its storage."""
    module.weight.data = _zeros(0).set_(module.weight.untyped_storage(), 2, (3, 3))


_CHANGES: list[Callable[[nn.Module], None]] = [
    lambda module: module.weight[2].add_(1),
    lambda module: module.weight.data[0].add_(1),
    lambda module: setattr(module.weight, "data", _zeros(3, 3)),
    lambda module: setattr(module.weight, "data", module.weight.data.t()),
    _shift,
    lambda module: module.weight.untyped_storage().resize_(4096),
    lambda module: setattr(module, "weight", nn.Parameter(_zeros(3, 3))),
    lambda module: module._parameters.update(weight=nn.Parameter(_zeros(3, 3))),
    lambda module: torch.utils.swap_tensors(module.weight, nn.Parameter(_zeros(3, 3))),
]
