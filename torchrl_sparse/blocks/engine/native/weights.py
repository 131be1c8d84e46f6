"""Packed weights shared by all engines of one network, and the check for weight changes at each policy call."""

from __future__ import annotations

import ctypes
from ctypes import c_float, c_void_p
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.native.library import loaded
from torchrl_sparse.blocks.engine.native.packing import PackedWeights
from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["NativeWatch", "SharedWeights"]


class NativeWatch(WeightWatch):
    """Weight watch that reads the first values of each parameter in one native call."""

    def locate(self, samples: list[Tensor]) -> ctypes.Array:
        for sample in samples:
            if not sample.is_cpu or sample.dtype != torch.float32:
                raise InputError(
                    f"native engine: it reads float32 weights on the CPU, the network was changed to {sample.dtype} on "
                    f"{sample.device}"
                )
        places = [value.data_ptr() for sample in samples for value in sample]
        return (c_void_p * len(places))(*places)

    def read(self, places: ctypes.Array) -> bytes:
        values = (c_float * len(places))()
        loaded().sparse_gather(len(places), places, values)
        return bytes(values)


class SharedWeights:
    """Packed weights of one network in one type, shared by engines of any sampler, plan and policy.

    So a network's methods beside each other need its weights in memory once, and do not drive each other's out of the caches.
    :meth:`of` gives the one of a network and a type.
    """

    _all: WeakKeyDictionary[TransformerForDiffusion, dict[torch.dtype, SharedWeights]] = WeakKeyDictionary()

    def __init__(self, network: TransformerForDiffusion, dtype: torch.dtype) -> None:
        self._dtype, self._watch = dtype, NativeWatch(network)
        self._packed: tuple[tuple | None, PackedWeights | None] = (None, None)

    @classmethod
    def of(cls, network: TransformerForDiffusion, dtype: torch.dtype) -> SharedWeights:
        """Return the shared weights of ``network``, which are kept for as long as the network lives."""
        types = cls._all.setdefault(network, {})
        return types.get(dtype) or types.setdefault(dtype, cls(network, dtype))

    def current(self) -> PackedWeights:
        """Return the packed weights, packing them again if the network has changed.

        Raises:
            InputError: naming a weight that cannot be packed.
        """
        version = self._watch.state()
        known, packed = self._packed  # read and replaced in one go: other threads may do the same
        if packed is None or known != version:
            packed = PackedWeights(self._watch.network, self._dtype)
            self._packed = version, packed
        return packed

    def refresh(self) -> None:
        """Pack the weights again at the next policy call of any engine."""
        self._watch.refresh()
