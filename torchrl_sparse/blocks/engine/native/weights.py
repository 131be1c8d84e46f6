"""The packed weights of a network, once for all engines that run it, and how a query notices that they have changed."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_uint64, c_void_p
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.native.library import library
from torchrl_sparse.blocks.engine.native.packing import PackedWeights
from torchrl_sparse.blocks.engine.weights import Members, WeightWatch
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["NativeWatch", "SharedWeights"]

_LINE = 64  # bytes that a cache reads together
_WORD = ctypes.sizeof(c_void_p)


class NativeWatch(WeightWatch):
    """Reads the values in compiled code: after a query the caches have lost them, and PyTorch is slow to ask for them.

    They have lost what Python and PyTorch know of the weights as well, some 2,000 places that lead to one another. All of
    them are asked for at once, before Python goes from one to the next.
    """

    def __init__(self, network: torch.nn.Module) -> None:
        self._lines: tuple[Members | None, ctypes.Array | None] = (None, None)
        super().__init__(network)

    def approach(self, members: Members) -> None:
        known, lines = self._lines  # read and replaced in one go: other threads may do the same
        if known is not members:
            lines = _addresses(_cache_lines(members))
            self._lines = members, lines
        library().sparse_fetch(len(lines), lines)

    def locate(self, samples: list[Tensor]) -> ctypes.Array:
        for sample in samples:
            if not sample.is_cpu or sample.dtype != torch.float32:
                raise ValueError(
                    f"native engine: it reads float32 weights on the CPU, the network was changed to {sample.dtype} on "
                    f"{sample.device}"
                )
        return _addresses([value.data_ptr() for sample in samples for value in sample])

    def read(self, places: ctypes.Array) -> bytes:
        values = (c_float * len(places))()
        library().sparse_gather(len(places), places, values)
        return bytes(values)


def _addresses(places: list[int]) -> ctypes.Array:
    return (c_void_p * len(places))(*places)


def _cache_lines(members: Members) -> list[int]:
    """Return where CPython and PyTorch keep what they know of ``members``, as far as they can be guessed from outside.

    The addresses are only ever fetched into a cache, which does no harm whatever lies there, and be it nothing any more.
    """
    spans = []
    for parameter in members.parameters:
        tensor = parameter._cdata
        storage, *others = _words(tensor, 2, 6)  # autograd's part, rare members, the version
        spans += [(id(parameter), 2), (tensor, 4), (storage, 2), *((place, 1) for place in others)]
    for holder in members.holders:
        (entries,) = _words(id(holder), 4, 5)
        spans += [(id(holder), 1), (entries, 3)]
    return sorted({start // _LINE * _LINE + _LINE * i for start, count in spans for i in range(count)})


def _words(place: int, first: int, last: int) -> list[int]:
    """Return words of an object that is alive and not smaller than that."""
    return [c_uint64.from_address(place + _WORD * i).value for i in range(first, last)]


class SharedWeights:
    """The packed weights of one network in one type: engines of whatever sampler, plan and policy read the same memory.

    So a network's methods beside each other need its weights in memory once, and do not drive each other's out of the caches.
    :meth:`of` gives the one of a network and a type.
    """

    _all: WeakKeyDictionary[TransformerForDiffusion, dict[torch.dtype, SharedWeights]] = WeakKeyDictionary()

    def __init__(self, network: TransformerForDiffusion, dtype: torch.dtype) -> None:
        self._dtype, self._watch = dtype, NativeWatch(network)
        self._packed: tuple[tuple | None, PackedWeights | None] = (None, None)

    @classmethod
    def of(cls, network: TransformerForDiffusion, dtype: torch.dtype) -> SharedWeights:
        """Return what is shared of ``network``, for as long as that lives."""
        types = cls._all.setdefault(network, {})
        return types.get(dtype) or types.setdefault(dtype, cls(network, dtype))

    def current(self) -> PackedWeights:
        """Return the packed weights, packed anew if the network has changed.

        Raises:
            ValueError: naming a weight that cannot be packed.
        """
        version = self._watch.state()
        known, packed = self._packed  # read and replaced in one go: other threads may do the same
        if packed is None or known != version:
            packed = PackedWeights(self._watch.network, self._dtype)
            self._packed = version, packed
        return packed

    def refresh(self) -> None:
        """Pack the weights anew in the next query of any engine."""
        self._watch.refresh()
