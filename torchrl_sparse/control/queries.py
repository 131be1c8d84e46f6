"""Recorded policy calls of episodes, to compare policies on the same inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor

__all__ = ["answer", "in_turn", "record_queries"]


def record_queries(
    actor: ChunkExecutor, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> TensorDictBase:
    """Record the inputs and outputs of every policy call in one episode per seed: [number of calls].

    The calls are where the policy is; the environment is where it is made.

    What the policy leaves to its own next call is left out: it would have to be the call before's. The chunk of that one and
    the steps since, 0 in the first, are there whether the policy reads them or not, so that another can be asked that does.

    Args:
        actor: whose policy is asked.
        make_env: called as ``make_env(seeds=[...])``.
        seeds: of the episodes.
    """
    env = make_env(seeds=list(seeds))
    episodes = [env.rollout(env.base_env.horizon, actor, auto_cast_to_device=True) for _ in seeds]
    env.close()
    read, written = actor.policy.in_keys, actor.policy.out_keys
    left = set(read) & set(written)  # for its next query: to be read, it belongs to the one before
    wanted = [*(key for key in (*read, *written) if key not in left), keys.LAST_CHUNK, keys.ELAPSED]
    queries = torch.cat([_queries(steps).select(*wanted, strict=False) for steps in episodes])
    return queries.to(actor.policy.device)


def _queries(steps: TensorDictBase) -> TensorDictBase:
    """Return the policy calls among the steps of an episode, [T], each with the last chunk before it."""
    asked = steps[keys.QUERIED].squeeze(-1).nonzero().squeeze(-1)
    queries, before = steps[asked], steps[asked - 1]  # the first one's, the last step of all, does not count
    queries.set(keys.LAST_CHUNK, before[keys.CHUNK])
    return queries.set(keys.ELAPSED, (before[keys.AGE] + 1) * (asked > 0)[:, None])


@torch.no_grad()
def answer(policy: TensorDictModuleBase, queries: TensorDictBase) -> TensorDictBase:
    """Run ``policy`` on recorded policy calls, with the same observations and noise; ``queries`` is not modified.

    All [N] run at once, or one after another if the policy carries keys between calls, see `in_turn`; a single one [] as the
    first.
    """
    if not queries.ndim or not _unrecorded(policy, queries):
        return policy(queries.select(*policy.in_keys, strict=False))
    return torch.stack([policy(query) for query in in_turn(policy, queries.unbind(0))])


def in_turn(policy: TensorDictModuleBase, queries: Iterable[TensorDictBase]) -> Iterator[TensorDictBase]:
    """Yield the inputs of ``policy`` for one recorded policy call after another, each in a TensorDict of its own.

    What it leaves to its own next call, such as scores of visual tokens, was not recorded of another policy. It is taken
    from the TensorDict that was yielded before, which the policy has to have answered in place by then.
    """
    before, left = None, []
    for query in queries:
        asked = query.select(*policy.in_keys, strict=False)
        if before is None:
            left = _unrecorded(policy, query)
        elif left:
            asked.update(before.select(*left, strict=False))
        yield asked
        before = asked


def _unrecorded(policy: TensorDictModuleBase, queries: TensorDictBase) -> list[NestedKey]:
    """Return the keys that ``policy`` leaves to itself and that the policy calls do not hold."""
    held = set(queries.keys(True, True))
    return [key for key in policy.in_keys if key in policy.out_keys and unravel_key(key) not in held]
