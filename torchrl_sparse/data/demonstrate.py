"""Recording of one scripted demonstration in an environment; a policy may drive its first steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.data.dagger import Driver
from torchrl_sparse.data.hdf5_writer import Episode
from torchrl_sparse.envs.tasks import Task

__all__ = ["demonstrate"]

# Keeps the operator's random numbers apart from those of the initial state, which has the same seed.
_EXPERT_STREAM = 1
_OBSERVED = "obs/"


def demonstrate(
    task: Task, env: EnvBase, seed: int, quality: str = "proficient", driver: Driver | None = None
) -> Episode:
    """Play one scripted episode until success or the environment's horizon, and record it.

    Args:
        task: what is demonstrated.
        env: its environment; in robosuite one of absolute actions.
        seed: fixes the initial state, the operator, their style and every disturbance.
        quality: "proficient", "recovering" or "mixed".
        driver: drives until the expert takes over; None for the expert alone.

    Raises:
        InputError: if the task has no expert or the quality is unknown.

    Examples:
        >>> from torchrl_sparse.envs.tasks import find_task
        >>> task = find_task("lift")
        >>> episode = demonstrate(task, task.make(), seed=0)
        >>> episode.success, episode.actions.shape[1]
        (True, 7)
    """
    rng = np.random.default_rng([seed, _EXPERT_STREAM])
    env.set_seed(seed)
    present = env.reset()
    demonstrator = task.demonstrator(task, env, rng, quality)
    steps: list[dict[str, Any]] = []
    driven = driver.begin(seed, env) if driver is not None else 0
    done = False
    while not done:
        state, observed = demonstrator.record(present)
        clean = demonstrator.label(present)
        if driver is not None and len(steps) < driven:
            executed = demonstrator.recorded(driver.act(present))
        else:
            executed = demonstrator.disturb(clean)
        command = torch.as_tensor(demonstrator.command(executed), dtype=torch.float32)
        present = env.step(present.set(keys.ACTION, command))["next"]
        done = bool(present["done"])
        steps.append(
            {"state": state, "clean": clean, "executed": executed, "success": bool(present[keys.SUCCESS])}
            | {_OBSERVED + name: value for name, value in observed.items()}
        )
    arrays = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    return Episode(
        seed=seed,
        operator=demonstrator.operator,
        instruction=demonstrator.instruction,
        success=bool(arrays["success"][-1]),
        model_file=demonstrator.model_file,
        states=arrays["state"],
        actions=arrays["clean"],
        executed_actions=arrays["executed"],
        rewards=arrays["success"].astype(np.float64),
        dones=arrays["success"].astype(np.int64),
        observations={
            name.removeprefix(_OBSERVED): array
            for name, array in arrays.items()
            if name.startswith(_OBSERVED)
        },
        driven=min(driven, len(steps)),
    )
