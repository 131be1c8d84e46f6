"""Closed-loop observations of a pruned policy, for its calibration set."""

from __future__ import annotations

from pathlib import Path

from tensordict import TensorDictBase

from torchrl_sparse.blocks.schedule import SchedulePlanner
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import CLOSED_LOOP_SEED, tuning_seeds
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps

__all__ = ["closed_loop_queries"]


def closed_loop_queries(
    policy: DiffusionPolicy, task: str, episodes: int, schedule: str | Path | None = None
) -> TensorDictBase:
    """Record the policy calls of episodes, see `torchrl_sparse.control.queries.record_queries`.

    Args:
        policy: the trained policy.
        task: that it is played on.
        episodes: how many, of seeds that no table reaches.
        schedule: of the blocks that are pruned meanwhile; None plays the dense policy.
    """
    planner = None if schedule is None else SchedulePlanner.from_pretrained(schedule)
    n_action_steps = executed_steps(task, policy.source)
    actor = ChunkExecutor(policy.with_plan(planner), n_action_steps=n_action_steps)
    return record_queries(actor, diffusion_env(task, policy), tuning_seeds(CLOSED_LOOP_SEED, episodes))
