"""Scripted demonstrations of the benchmarks outside robosuite, in the same files as those of robosuite."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_sparse import keys
from torchrl_sparse.data.hdf5_writer import Episode
from torchrl_sparse.envs.benchmarks import Benchmark
from torchrl_sparse.envs.experts.benchmarks import make_benchmark_expert
from torchrl_sparse.envs.seeded import SeededEnv

__all__ = ["benchmark_env_args", "demonstrate_benchmark"]

_MEMORY = 0.8  # autocorrelation of the noise from one step to the next


def demonstrate_benchmark(
    env: SeededEnv, task: Benchmark, seed: int, rng: np.random.Generator, quality: str = "proficient"
) -> Episode:
    """One scripted episode, to success or to the environment's horizon.

    Args:
        env: an environment of ``task``.
        task: which benchmark.
        seed: fixes the initial state.
        rng: draws the expert's preferences and the noise on what it does; its labels stay clean, as in DART
            (arXiv:1703.09327).
        quality: "proficient"; these experts have no other.

    Raises:
        ValueError: if the benchmark has no expert, or not of that quality.
    """
    if quality != "proficient":
        raise ValueError(f"quality: expected 'proficient' for {task.name}, got {quality!r}")
    expert = make_benchmark_expert(task.name, rng)
    env.set_seed(seed)
    present, noise = env.reset(), np.zeros(task.action_dim)
    rows: dict[str, list[Any]] = {name: [] for name in ("state", "clean", "executed", "success")}
    done = False
    while not done:
        state = present[keys.STATE].double().numpy()
        clean = expert.command(state)
        noise = _MEMORY * noise + np.sqrt(1 - _MEMORY**2) * rng.standard_normal(len(noise))
        executed = clean + expert.noise * noise
        present = env.step(present.set(keys.ACTION, torch.as_tensor(executed, dtype=torch.float32)))["next"]
        done, success = bool(present["done"]), bool(present[keys.SUCCESS])
        for name, value in zip(rows, (state, clean, executed, success), strict=True):
            rows[name].append(value)
    arrays = {name: np.stack(values) for name, values in rows.items()}
    return Episode(
        seed=seed,
        operator=quality,
        instruction=None,
        success=bool(arrays["success"][-1]),
        model_file="",
        states=arrays["state"],
        actions=arrays["clean"],
        executed_actions=arrays["executed"],
        rewards=arrays["success"].astype(np.float64),
        dones=arrays["success"].astype(np.int64),
        observations={"state": arrays["state"]},
    )


def benchmark_env_args(task: Benchmark) -> dict[str, Any]:
    """robomimic's description of the environment that demonstrations were made in."""
    return {"env_name": task.name, "env_kwargs": {}, "type": 2}  # robomimic's EnvType.GYM_TYPE
