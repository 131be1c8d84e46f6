"""Steps of robosuite's tasks through TorchRL's collector, compiled and in Python, beside the physics alone."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from statistics import median
from time import process_time
from typing import Any

from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.results.world_report import WorldProfile, WorldTimes
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["TASKS", "measure_world"]

TASKS = ("lift", "can", "square", "transport")
"""Of the table."""

_STEPS = 48  # of an episode, as short as a solved one of Lift: resets weigh most there


def measure_world(
    tasks: Sequence[str] | None = None, *, threads: int | None, repeats: int, warmup: int
) -> WorldProfile:
    """Measure whole short episodes under random actions, compiled and as robosuite has it, in turns in one process.

    Args:
        tasks: of robosuite; `TASKS` by default.
        threads: of PyTorch.
        repeats, warmup: rounds; each takes one episode either way. Seconds are of the process, medians of the rounds.
    """
    with num_threads(threads):
        return WorldProfile(
            "world/1",
            describe_machine(),
            _STEPS,
            {task: _measure(task, repeats, warmup) for task in tasks or TASKS},
        )


def _measure(task: str, repeats: int, warmup: int) -> WorldTimes:
    worlds = {way: _World(task, compiled=way == "compiled") for way in ("python", "compiled")}
    taken: list[dict[str, float]] = []
    for _ in range(warmup + repeats):
        times = {}
        for way, world in worlds.items():
            times[f"{way}_step_s"] = world.episode()
            times[f"{way}_reset_s"] = world.reset()
        times["physics_s"] = worlds["compiled"].physics()
        taken.append(times)
    for world in worlds.values():
        world.close()
    return WorldTimes(**{name: median(times[name] for times in taken[warmup:]) for name in taken[0]})


class _World:
    """One environment in a collector."""

    def __init__(self, task: str, *, compiled: bool):
        self._env: TransformedEnv = make_env(task, action_mode="delta", horizon=_STEPS, compiled=compiled)
        self._collector = Collector(self._env, None, frames_per_batch=_STEPS, total_frames=-1)
        self._batches: Iterator[Any] = iter(self._collector)

    def episode(self) -> float:
        """Return seconds of a step that the collector takes, the reset of its episode included."""
        begin = process_time()
        next(self._batches)
        return (process_time() - begin) / _STEPS

    def reset(self) -> float:
        """Return seconds of a reset."""
        begin = process_time()
        self._env.base_env.reset()
        return process_time() - begin

    def physics(self) -> float:
        """Return seconds of the substeps of one step, nothing but MuJoCo's, from the present state."""
        import mujoco

        env = self._env.base_env.sim_env
        model, data = env.sim.model._model, copy.copy(env.sim.data._data)
        substeps = _STEPS * int(env.control_timestep / env.model_timestep)
        begin = process_time()
        for _ in range(substeps):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)
        return (process_time() - begin) / _STEPS

    def close(self) -> None:
        self._collector.shutdown()
