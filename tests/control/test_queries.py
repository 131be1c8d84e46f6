"""Recorded queries: what was there to be read when each was made."""

from itertools import cycle

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer, in_turn, record_queries


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


TOTAL = ("test", "total")


class Remembering(TensorDictModuleBase):
    """Adds up what it was asked in an episode, under a key of its own."""

    in_keys = ["step", keys.ELAPSED, TOTAL]
    out_keys = [TOTAL, keys.CHUNK]

    def forward(self, td):
        before = keys.recall(td, TOTAL, (1,), 0.0)
        total = td["step"] + before.masked_fill(td[keys.ELAPSED] == 0, 0.0)
        td[TOTAL] = total
        return td.set(keys.CHUNK, total[..., None])


def test_what_a_policy_leaves_to_itself_is_not_recorded():
    """Recorded beside a policy call it would be of that call, where it is to be read of the one before."""
    policy = Remembering()
    policy.device = torch.device("cpu")
    actor = ChunkExecutor(policy, n_action_steps=1)
    queries = record_queries(actor, lambda seeds: CountingEnv(), [1])
    assert TOTAL not in queries.keys(True, True)
    assert torch.equal(answer(policy, queries)[keys.CHUNK], queries[keys.CHUNK])
    assert queries[keys.CHUNK].flatten().tolist() == [0, 1, 3, 6, 10, 15, 21]


def recorded():
    """Two episodes of three policy calls."""
    elapsed = torch.tensor([[0], [3], [3], [0], [3], [3]])
    return TensorDict({"step": torch.arange(1.0, 7)[:, None], keys.ELAPSED: elapsed}, [6])


def test_a_policy_that_remembers_is_asked_in_turn():
    queries = recorded()
    before = queries.clone()
    expected = [1, 3, 6, 4, 9, 15]
    assert answer(Remembering(), queries)[keys.CHUNK].flatten().tolist() == expected
    assert (queries == before).all()
    assert set(queries.keys(True, True)) == set(before.keys(True, True))


def test_what_was_recorded_counts_and_is_asked_at_once():
    queries = recorded().set(TOTAL, torch.full((6, 1), 100.0))
    assert answer(Remembering(), queries)[keys.CHUNK].flatten().tolist() == [1, 102, 103, 4, 105, 106]


def test_queries_go_round():
    policy, totals = Remembering(), []
    for _, query in zip(range(8), in_turn(policy, cycle(recorded().unbind(0))), strict=False):
        totals.append(policy(query)[TOTAL].item())
    assert totals == [1, 3, 6, 4, 9, 15, 1, 3]


def test_a_policy_that_leaves_itself_nothing_reads_what_was_recorded():
    policy = OnCPU(lambda step: step[..., None], in_keys=["step"], out_keys=[keys.CHUNK])
    asked = [query["step"].item() for query in in_turn(policy, recorded().unbind(0))]
    assert asked == [1, 2, 3, 4, 5, 6]
