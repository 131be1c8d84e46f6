"""What a server says of itself when a robot connects."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from torchrl_sparse.envs.contract import Contract
from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask
from torchrl_sparse.serving.robot import RobotSetup

__all__ = ["describe_service"]


def describe_service(
    setup: RobotSetup, contract: Contract | None, facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Return plain values: task, state, cameras, rate, chunk, engine, and the policy's description in words.

    ``control_freq`` is actions a second, None where nobody says it; a camera's shape is [h, w, 3]; a chunk's [n, A].
    """
    policy = setup.executor.policy
    task = None if contract is None else contract.task
    known = isinstance(TASKS.get(task or ""), RobosuiteTask)
    shape = [] if policy.vision is None else [*policy.vision.image_size, 3]
    cameras = [] if policy.vision is None else [*policy.vision.cameras]
    named = {} if contract is None else dict(contract.cameras)
    return {
        "server": f"torchrl_sparse {version('torchrl-sparse')}",
        "task": task,
        "state": {
            "size": policy.normalizer.state_scale.numel(),
            "keys": [] if contract is None else [*contract.state_keys],
            "robosuite": None if contract is None or not known else contract.convention,
        },
        "cameras": {name: {"name": named.get(name, name), "shape": shape} for name in cameras},
        "n_obs_steps": setup.n_obs_steps,
        "control_freq": policy.source.get("control_freq") or (CONTROL_FREQ if known else None),
        "answers": setup.answers,
        "chunk": [*setup.chunk_shape],
        "n_action_steps": setup.executor.n_action_steps,
        "seed": setup.seed,
        "engine": policy.engine_info(),
        "sampler": policy.sampler.name,
        "planner": type(policy.plan).__name__,
        "description": policy.describe(),
        **facts,
    }
