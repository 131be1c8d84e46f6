"""Queries of a diffusion policy recorded in its environment, to train on, to calibrate with, and to compare methods on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.calibration import Calibration, calibrate
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["calibrate_policy", "record_queries"]


def record_queries(
    actor: ChunkExecutor, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> TensorDictBase:
    """Return every query of one episode per seed, [number of queries]: what the policy read and what it answered.

    Args:
        actor: the policy and how its chunks are executed.
        make_env: called as ``make_env(seeds=[...])``.
        seeds: of the episodes.
    """
    env = make_env(seeds=list(seeds))
    episodes = [env.rollout(env.base_env.horizon, actor) for _ in seeds]
    env.close()
    wanted = [*actor.policy.in_keys, *actor.policy.out_keys]
    return torch.cat([steps[steps[keys.QUERIED].squeeze(-1)].select(*wanted) for steps in episodes])


def calibrate_policy(
    policy: DiffusionPolicy, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> Calibration:
    """Calibrate on the first observation of one episode per seed, as BAC's release does with a single one."""
    env = make_env(seeds=list(seeds))
    first = torch.stack([env.reset() for _ in seeds])
    env.close()
    encoded = policy.module["encode"](first)
    noise = policy.sample_noise(encoded[keys.SEED].squeeze(-1))
    return calibrate(policy.network, policy.sampler, noise, encoded[keys.COND])
