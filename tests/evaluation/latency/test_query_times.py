"""Timing recorded queries: each is asked, of every method, and of its time the planner's part is told apart."""

import time

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, TransformerForDiffusion, keys
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.evaluation.latency.queries import time_planning, time_queries

QUERIES = TensorDict({"history": {"state": torch.arange(3.0).view(3, 1, 1).expand(3, 2, 5).clone()}}, [3])


class Slow(Planner):
    """Sleeps, and notes what it was asked."""

    def __init__(self):
        super().__init__()
        self.asked, self.rows = [], []

    def masks(self, cond):
        self.asked.append(cond[0, 0, 0].item())
        self.rows.append(len(cond))
        time.sleep(0.02)
        return torch.zeros(len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool)


@pytest.fixture
def policy():
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
    network = TransformerForDiffusion(**sizes, n_layer=1, n_emb=16)
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddim", 2), plan=Slow())


def test_every_round_asks_all_methods_the_next_query(policy):
    twin = DiffusionPolicy(policy.network, policy.normalizer, sampler=policy.sampler, plan=Slow())
    latency = time_queries({"a": policy, "b": twin}, QUERIES, repeats=4, threads=1)
    # After three rounds to warm up.
    assert policy.plan.asked == twin.plan.asked == [0, 1, 2, 0, 1, 2, 0]
    assert latency["a"].n == latency["b"].n == 4


def test_a_query_of_several_samples_is_timed_as_one_batch(policy):
    time_queries({"of4": policy}, QUERIES, repeats=1, threads=1, samples={"of4": 4})
    assert set(policy.plan.rows) == {4}
    assert policy.plan.asked == [0, 1, 2, 0]


def test_the_planner_is_timed_within_its_queries(policy):
    latency = time_planning({"slow": policy}, QUERIES, threads=1)["slow"]
    assert policy.plan.asked == [0, 0, 1, 2]  # once to warm up
    assert latency.n == 3
    assert latency.p50 >= 0.02
    assert keys.PRUNE_MASK not in QUERIES.keys(include_nested=True)


def test_a_policy_is_timed_with_what_it_left_itself(policy):
    class Counting(Planner):
        """Counts the policy calls of an episode, under a key of its own."""

        in_keys = [*Planner.in_keys, keys.ELAPSED, "count"]
        out_keys = [*Planner.out_keys, "count"]
        counts = []

        def options(self, tensordict, rows):
            count = keys.recall(tensordict, "count", (1,), 0) + 1
            tensordict["count"] = count.masked_fill(tensordict[keys.ELAPSED] == 0, 0)
            self.counts.append(tensordict["count"].item())
            return {}

        def masks(self, cond):
            return torch.zeros(
                len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool
            )

    policy.plan = Counting()
    queries = QUERIES.clone().set(keys.ELAPSED, torch.tensor([[0], [8], [8]]))
    time_queries({"counting": policy}, queries, repeats=3, threads=1)
    assert policy.plan.counts == [0, 1, 2, 0, 1, 2]  # three to warm up
