"""Recorded queries: what was there to be read when each was made."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import record_queries


class OnCPU(TensorDictModule):
    device = torch.device("cpu")


class CountingEnv:
    """An episode of seven steps, each observed by its number."""

    horizon = 7

    @property
    def base_env(self):
        return self

    def rollout(self, horizon, actor, auto_cast_to_device):
        steps, td = [], TensorDict()
        for at in range(horizon):
            td["step"], td[keys.IS_INIT] = torch.tensor([float(at)]), torch.tensor([at == 0])
            td = actor(td)
            steps.append(td.clone())
        return torch.stack(steps)

    def close(self):
        pass


def test_a_query_is_recorded_with_the_chunk_before_it():
    policy = OnCPU(lambda step: step[..., None].repeat(1, 4, 2), in_keys=["step"], out_keys=[keys.CHUNK])
    queries = record_queries(ChunkExecutor(policy, n_action_steps=3), lambda seeds: CountingEnv(), [1, 2])
    assert queries["step"].flatten().tolist() == [0, 3, 6, 0, 3, 6]
    assert queries[keys.ELAPSED].flatten().tolist() == [0, 3, 3, 0, 3, 3]
    assert queries[keys.LAST_CHUNK][[1, 2, 4, 5], 0, 0].tolist() == [0, 3, 0, 3]
