"""Profile of one policy call: its parts, its thread scaling, and its tail latency."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import c_size_t, c_uint64, c_void_p
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.factory import ENGINES
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.packing import units
from torchrl_sparse.blocks.engine.native.weights import NativeWatch
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import measure_latency, next_arguments
from torchrl_sparse.evaluation.latency.stages import example_query, stage_seconds
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = [
    "busy_cores",
    "call_parts",
    "exported_call",
    "paced_seconds",
    "policy_inputs",
    "query_parts",
    "serial_share",
    "tail",
    "thread_seconds",
]

_PERCENTILES = (50, 99, 99.9, 100)
_WEIGHTS = {"native_bf16": "bfloat16", "native_int8": "int8"}


def call_parts(policy: DiffusionPolicy, repeats: int, warmup: int = 3) -> dict[str, float]:
    """Measure a policy call and its parts: `query_parts` if it runs as two native calls, else `stage_seconds`.

    Raises:
        InputError: if its engine cannot run here, or a policy of states under a static plan runs in another than native.
    """
    if policy.vision is None and policy.plan.is_static and not policy.start.name:
        return query_parts(policy, repeats, warmup)
    return stage_seconds(policy, example_query(policy), repeats, warmup)


@torch.no_grad()
def query_parts(policy: DiffusionPolicy, repeats: int, warmup: int = 3) -> dict[str, float]:
    """Measure the median seconds of a native policy call and of its parts, interleaved.

    Args:
        policy: of states, on the CPU, with a planner that ignores the observation.
        repeats: timed rounds.
        warmup: untimed rounds before them.

    Returns:
        ``"query"``, the whole of it, and its parts, which add up to it: ``"noise"``, drawn; ``"weights"``, asked whether
        they are the same; ``"blocks"``, those that the mask leaves; ``"compiled rest"``: units, the encoder, head and
        sampler; ``"tensors"``: keys of the TensorDict, Python, and the clock.

    Raises:
        InputError: if another engine runs the policy, or the planner looks at the observation.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift", engine="native")
        >>> policy.sampler = Sampler("ddim", timesteps=[87, 20])
        >>> parts = query_parts(policy, repeats=3)
        >>> query = parts.pop("query")
        >>> abs(query - sum(parts.values())) < 1e-9
        True
    """
    query = example_query(policy)
    engine = policy.module["denoise"].engine.get(policy.network, policy.sampler)
    if not isinstance(engine, NativeEngine):
        raise InputError(f"engine: expected native, got {engine.name}")
    if not policy.plan.is_static:
        raise InputError(f"plan: expected one that ignores the observation, got {type(policy.plan).__name__}")
    noise, state, seed = policy.sample_noise(torch.tensor([1])), query["history", "state"], torch.tensor([1])
    mask, watch = policy.plan.static_mask, NativeWatch(policy.network)
    chunk = policy(query.copy())[keys.CHUNK]

    def answer() -> None:
        scales = units(policy.normalizer)
        cond = engine.condition(state, scales)
        engine.answer(engine.ready(noise, cond), noise, cond, scales, mask, chunk, policy.plan.reuse)

    latency = measure_latency(
        {
            "query": policy,
            "noise": partial(policy.sample_noise, seed),
            "weights": watch.state,
            "answer": answer,
        },
        repeats,
        warmup,
        inputs={"query": policy_inputs(policy)},
    )
    seconds = {name: found.p50 for name, found in latency.items()}
    each = torch.tensor(list(engine.block_seconds().values()), dtype=torch.float64)
    blocks = float(((~mask).view(-1, 3) * each).sum())
    return {
        "query": seconds["query"],
        "noise": seconds["noise"],
        "weights": seconds["weights"],
        "blocks": blocks,
        "compiled rest": seconds["answer"] - seconds["weights"] - blocks,
        "tensors": seconds["query"] - seconds["noise"] - seconds["answer"],
    }


def thread_seconds(
    network: TransformerForDiffusion,
    samplers: Mapping[str, Sampler],
    threads: Sequence[int],
    repeats: int,
    warmup: int = 2,
    *,
    engine: str = "native",
) -> dict[str, dict[int, float]]:
    """Measure the median seconds of each sampler's unpruned policy call on each number of threads, all interleaved.

    Args:
        network: the denoiser, on the CPU.
        samplers: by name.
        threads: numbers of them.
        repeats, warmup: rounds, see `measure_latency`.
        engine: one of the native ones.

    Returns:
        name of the sampler -> threads -> seconds.
    """
    generator = torch.Generator().manual_seed(0)
    cond = torch.randn(1, network.n_obs_steps, network.cond_dim, generator=generator)
    calls: dict[str, Callable[[], Any]] = {}
    for name, sampler in samplers.items():
        shape = (1, sampler.num_inference_steps, network.horizon, network.input_dim)
        noise = torch.randn(shape, generator=generator)
        for count in threads:
            runner = ENGINES[engine].make(network, sampler, threads=count)
            calls[f"{name} {count}"] = partial(runner.denoise, noise, cond)
    latency = measure_latency(calls, repeats, warmup)
    return {name: {count: latency[f"{name} {count}"].p50 for count in threads} for name in samplers}


def serial_share(seconds: dict[int, float]) -> float:
    """Return the least-squares serial share s of Amdahl's law, ``t(n) = t(1) (s + (1 - s) / n)``, for times on n threads, 1
    included.

    >>> round(serial_share({1: 1.0, 2: 0.6, 4: 0.4}), 3)
    0.2
    """
    others = [count for count in seconds if count > 1]
    gained = np.array([1 - 1 / count for count in others])
    missing = np.array([seconds[count] / seconds[1] - 1 / count for count in others])
    return float(missing @ gained / (gained @ gained)) if others else 0.0


@torch.no_grad()
def paced_seconds(
    calls: Mapping[str, Callable[..., Any]],
    queries: int,
    hz: float | None,
    on_query: Callable[[int, int], None] | None = None,
    *,
    inputs: Mapping[str, Iterator[Any]] | None = None,
) -> dict[str, list[float]]:
    """Time many calls of each caller, started ``hz`` times a second as in a control loop; None: back to back.

    Callers in ``inputs`` get their next input, made before the call begins. Several callers take turns, spread evenly over the
    period. A call that comes late delays the next; each is timed from its own beginning.

    Returns:
        name of a caller -> seconds of its ``queries``, in order. Ctrl-C ends it with as many of each as there are by then.

    Raises:
        KeyboardInterrupt: on Ctrl-C before every caller has been timed once.
    """
    inputs = inputs or {}
    for name, call in calls.items():
        call(*next_arguments(inputs, name))
    samples: dict[str, list[float]] = {name: [] for name in calls}
    begin = time.perf_counter()
    try:
        for number in range(queries):
            for turn, (name, call) in enumerate(calls.items()):
                given = next_arguments(inputs, name)
                if hz is not None:
                    due = begin + (number + turn / len(calls)) / hz
                    time.sleep(max(0.0, due - time.perf_counter()))
                start = time.perf_counter()
                call(*given)
                samples[name].append(time.perf_counter() - start)
            if on_query is not None:
                on_query(number + 1, queries)
    except KeyboardInterrupt:
        if not all(samples.values()):
            raise
    whole = min(map(len, samples.values()))
    return {name: seconds[:whole] for name, seconds in samples.items()}


def policy_inputs(policy: DiffusionPolicy) -> Iterator[TensorDict]:
    """Yield the same observation repeatedly in new TensorDicts, since a policy writes into them."""
    query = example_query(policy)
    return (query.copy() for _ in repeat(None))


@contextmanager
def exported_call(policy: DiffusionPolicy, library: Path) -> Iterator[Callable[[], Any]]:
    """Export the policy and lend a function that makes the same policy call through the C interface, ``tsp.h``.

    Args:
        policy: of states, which `DiffusionPolicy.export` can write; with the weights that its engine rounds to.
        library: the shared library that CMake makes, ``libtsp.so``.

    Raises:
        InputError: if the library cannot be loaded or the policy not exported.
    """
    state = example_query(policy)["history", "state"].contiguous()
    chunk = torch.empty(policy.horizon - policy.n_obs_steps + 1, policy.network.output_dim)
    try:
        found = ctypes.CDLL(str(library.resolve()))
    except OSError as error:
        raise InputError(f"library: expected libtsp.so, got {library} ({error})") from error
    found.tsp_load.restype, found.tsp_free.argtypes = c_void_p, [c_void_p]
    found.tsp_query.argtypes = [c_void_p, c_void_p, c_uint64, c_void_p]
    with tempfile.TemporaryDirectory() as folder:
        policy.export(Path(folder) / "policy.tsp", weights=_WEIGHTS.get(policy.engine, "float32"))
        reason = ctypes.create_string_buffer(256)
        handle = found.tsp_load(f"{folder}/policy.tsp".encode(), reason, c_size_t(len(reason)))
    if handle is None:
        raise InputError(f"library: {reason.value.decode()}")
    try:
        yield lambda: found.tsp_query(handle, state.data_ptr(), 1, chunk.data_ptr())
    finally:
        found.tsp_free(handle)


def tail(samples: Sequence[float]) -> dict[str, float]:
    """Return percentiles ``"p50"``, ``"p99"``, ``"p99.9"`` and ``"max"`` of seconds.

    >>> tail([1.0, 1.0, 3.0])["p50"]
    1.0
    """
    values = np.percentile(samples, _PERCENTILES).tolist()
    return dict(zip(("p50", "p99", "p99.9", "max"), values, strict=True))


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Keep ``count`` processes busy during the block, to imitate other programs of a robot."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
