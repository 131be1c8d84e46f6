"""The queries of episodes: recorded once, so that any policy can be asked the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor

__all__ = ["answer", "record_queries"]


def record_queries(
    actor: ChunkExecutor, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> TensorDictBase:
    """Record every query of one episode per seed: [number of queries], with what the policy read and what it answered.

    Args:
        actor: whose policy is asked.
        make_env: called as ``make_env(seeds=[...])``.
        seeds: of the episodes.
    """
    env = make_env(seeds=list(seeds))
    episodes = [env.rollout(env.base_env.horizon, actor) for _ in seeds]
    env.close()
    wanted = [*actor.policy.in_keys, *actor.policy.out_keys]
    return torch.cat([steps[steps[keys.QUERIED].squeeze(-1)].select(*wanted) for steps in episodes])


@torch.no_grad()
def answer(policy: TensorDictModuleBase, queries: TensorDictBase) -> TensorDictBase:
    """Ask ``policy`` recorded queries: the same observations and noise, whatever was answered; ``queries`` stay as they are."""
    return policy(queries.select(*policy.in_keys, strict=False))
