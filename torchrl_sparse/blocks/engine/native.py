"""The native engine: one call of compiled code for each action chunk, on the CPU.

``native.cpp`` holds the loop, :mod:`~torchrl_sparse.blocks.engine.packing` prepares the weights and tables that
it reads, :mod:`~torchrl_sparse.blocks.engine.plan` the program that it executes. It is built when the package is
installed, as a plain shared library that knows nothing of Python or PyTorch, and is called through ctypes, which
releases the interpreter's lock.
"""

from __future__ import annotations

import ctypes
import importlib.machinery
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from ctypes import POINTER, c_int32, c_int64, c_void_p
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.packing import Model, PackedNetwork
from torchrl_sparse.blocks.engine.plan import Program, ProgramCache
from torchrl_sparse.blocks.engine.reference import check_query
from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, num_buffers

if TYPE_CHECKING:
    from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
    from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["INSTRUCTION_SETS", "NativeEngine", "native_available", "native_supports"]

INSTRUCTION_SETS = ("portable", "avx2", "avx512", "avx512_bf16")
_WEIGHTS = ("float32", "float16", "bfloat16")
_MAX_OBS_STEPS = 63


class _Program(ctypes.Structure):
    _fields_ = [("ops", c_void_p), ("starts", c_void_p), ("slots", c_int32)]


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | str:
    """The compiled library, or why there is none; then it also warns, once in a process."""
    library = _load(Path(__file__).parent)
    if isinstance(library, str):
        warnings.warn(f"torchrl_sparse runs without its native engine: {library}", stacklevel=2)
    return library


def _load(folder: Path) -> ctypes.CDLL | str:
    paths = [folder / f"_native{suffix}" for suffix in importlib.machinery.EXTENSION_SUFFIXES]
    path = next((path for path in paths if path.exists()), None)
    if path is None:
        return f"{paths[0].name} was not built (install a C++17 compiler, g++ or clang++, then this package again)"
    try:
        return _declare(ctypes.CDLL(str(path)))
    except (OSError, AttributeError) as error:
        return f"{path.name} cannot be loaded ({error}); install the package again"


def _declare(library: ctypes.CDLL) -> ctypes.CDLL:
    library.sparse_levels.restype = c_int32
    library.sparse_scratch.restype = c_int64
    library.sparse_scratch.argtypes = [POINTER(Model), c_int32]
    library.sparse_denoise.restype = None
    library.sparse_denoise.argtypes = [c_int32, POINTER(Model), POINTER(_Program), *[c_void_p] * 4]
    library.sparse_blocks.restype = None
    library.sparse_blocks.argtypes = [c_int32, POINTER(Model), c_int32, c_void_p]
    return library


def native_available() -> tuple[bool, str]:
    """Whether the native engine was built, and the instruction sets that it can use here or what is missing.

    Examples:
        >>> available, reason = native_available()
        >>> isinstance(available, bool), isinstance(reason, str)
        (True, True)
    """
    library = _library()
    if isinstance(library, str):
        return False, library
    return True, ", ".join(INSTRUCTION_SETS[: library.sparse_levels()])


def native_supports(network: TransformerForDiffusion) -> tuple[bool, str]:
    """Whether the native engine can run ``network`` on this machine, and if not, why.

    It needs the compiled library, f32 weights on the CPU, a token-wise condition encoder (``n_cond_layers`` = 0,
    as all published models have), a noise vector as large as an action, and at most 63 observation steps.
    """
    available, reason = native_available()
    if not available:
        return False, reason
    parameters = list(network.parameters())
    if any(parameter.device.type != "cpu" for parameter in parameters):
        return False, f"it runs on the CPU, the network is on {parameters[0].device}"
    if any(parameter.dtype != torch.float32 for parameter in parameters):
        return False, "it reads float32 weights"
    if network.n_cond_layers > 0:
        return False, f"it needs n_cond_layers = 0, the network has {network.n_cond_layers}"
    if network.output_dim != network.input_dim:
        return False, f"it needs output_dim = input_dim, got {network.output_dim} and {network.input_dim}"
    if network.n_obs_steps > _MAX_OBS_STEPS:
        return False, f"it needs n_obs_steps <= {_MAX_OBS_STEPS}, the network has {network.n_obs_steps}"
    return True, ""


class NativeEngine:
    """Runs queries in compiled code. Not differentiable.

    The weights are packed when the engine is made, and again when the network's have changed (see
    :class:`~torchrl_sparse.blocks.engine.weights.WeightWatch`). A row of a batch is computed exactly as it would be
    alone. Rows are spread over ``threads`` threads, of which the caller's is one; a query is never split, so that more
    threads than rows change nothing. Calls from several threads may overlap.

    Args:
        network: the denoiser, in eval mode; see :func:`native_supports`.
        schedule: the sampler.
        weights: ``"float32"``; ``"float16"`` for half the memory; ``"bfloat16"`` for half the memory and, on a CPU
            with AVX512-BF16, twice the multiply-adds, with activations rounded to bfloat16 as well.
        instruction_set: one of ``INSTRUCTION_SETS``; None takes the widest that the CPU has.
        threads: for the rows of a batch; None takes ``torch.get_num_threads()`` at each call.

    Attributes:
        name: ``"native"``.
        detail: instruction set and weight type.

    Raises:
        ValueError: if the engine cannot run the network or the instruction set, with the reason.

    Examples:
        >>> from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
        >>> from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> if native_available()[0]:
        ...     engine = NativeEngine(network, NoiseSchedule("ddim", 10))
        ...     actions = engine.denoise(torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5))
        ...     assert actions.shape == (3, 4, 7)
    """

    name = "native"

    def __init__(
        self,
        network: TransformerForDiffusion,
        schedule: NoiseSchedule,
        *,
        weights: str = "float32",
        instruction_set: str | None = None,
        threads: int | None = None,
    ) -> None:
        supported, reason = native_supports(network)
        if not supported:
            raise ValueError(f"native engine: {reason}")
        if weights not in _WEIGHTS:
            raise ValueError(f"weights: expected one of {list(_WEIGHTS)}, got {weights!r}")
        if threads is not None and threads < 1:
            raise ValueError(f"threads: expected at least 1, got {threads}")
        self.network, self.schedule, self.weights, self.threads = network, schedule, weights, threads
        self._level = _level(instruction_set)
        self._programs = ProgramCache()
        self._dense = np.zeros((schedule.num_inference_steps, network.num_blocks), bool)
        self._watch = WeightWatch(network)
        self._packed = (None, None)
        self._current()

    @property
    def detail(self) -> str:
        return f"{INSTRUCTION_SETS[self._level]}, {self.weights} weights"

    @torch.no_grad()
    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """Normalised actions f32 [B, H, A], see :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`.

        Raises:
            ValueError: also if the inputs are no float32 tensors on the CPU, or if the network is in training mode.
        """
        check_query(self.network, self.schedule, noise, cond, mask, reuse)
        self._check(noise, cond)
        noise, cond = noise.contiguous(), cond.contiguous()
        packed = self._current()
        slots = num_buffers(reuse, self.network.num_blocks)
        masks = [self._dense] * len(cond) if mask is None else mask.numpy()
        programs = [self._programs.get(rows) for rows in masks]
        actions = torch.empty(len(cond), self.network.horizon, self.network.input_dim)

        rows = iter(range(len(cond)))

        def work() -> None:
            scratch = self._scratch(packed, slots)
            for row in rows:  # each thread takes the next: one that is held up holds up nothing else
                self._run(packed, programs[row], slots, noise[row], cond[row], actions[row], scratch)

        helpers = min(self.threads or torch.get_num_threads(), len(cond)) - 1
        # It starts a thread for each task, and none for a single row.
        with ThreadPoolExecutor(max(helpers, 1)) as pool:
            tasks = [pool.submit(work) for _ in range(helpers)]
            work()
        for task in tasks:
            task.result()
        return actions

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """Seconds of one block of each type, ``{"SA": ..., "CA": ..., "FFN": ...}``.

        The best of ``repeats`` walks over all layers, so that weights come from where they do in a query.
        """
        packed = self._current()
        scratch = self._scratch(packed, len(BLOCK_TYPES)).zero_()
        return {
            name: self._time_block(packed, kind, repeats, scratch) for kind, name in enumerate(BLOCK_TYPES)
        }

    def _time_block(self, packed: PackedNetwork, kind: int, repeats: int, scratch: Tensor) -> float:
        best = float("inf")
        for _ in range(repeats):
            start = time.perf_counter()
            _library().sparse_blocks(self._level, packed.model, kind, scratch.data_ptr())
            best = min(best, time.perf_counter() - start)
        return best / self.network.n_layer

    def _run(self, packed, program: Program, slots: int, noise, cond, actions, scratch) -> None:
        pointers = _Program(program.ops.ctypes.data, program.starts.ctypes.data, slots)
        addresses = (tensor.data_ptr() for tensor in (noise, cond, actions, scratch))
        _library().sparse_denoise(self._level, packed.model, pointers, *addresses)

    def _scratch(self, packed: PackedNetwork, slots: int) -> Tensor:
        """Memory for one call at a time; PyTorch aligns it to cache lines."""
        return torch.empty(_library().sparse_scratch(packed.model, slots))

    def _current(self) -> PackedNetwork:
        """The packed weights, packed anew if the network has changed."""
        version = self._watch.state()
        known, packed = self._packed  # read and replaced in one go: other threads may do the same
        if known != version:
            packed = PackedNetwork(self.network, self.schedule, getattr(torch, self.weights))
            self._packed = (version, packed)
        return packed

    def _check(self, noise: Tensor, cond: Tensor) -> None:
        if self.network.training:
            raise ValueError("network: expected eval mode, got training mode (call network.eval())")
        for name, tensor in (("noise", noise), ("cond", cond)):
            if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
                raise ValueError(
                    f"{name}: expected float32 on the CPU, got {tensor.dtype} on {tensor.device}"
                )


def _level(instruction_set: str | None) -> int:
    available = INSTRUCTION_SETS[: _library().sparse_levels()]
    if instruction_set is None:
        return len(available) - 1
    if instruction_set not in available:
        raise ValueError(
            f"instruction_set: expected one of {list(available)} on this CPU, got {instruction_set!r}"
        )
    return available.index(instruction_set)
