"""Masks that are climbed to: what a swap keeps, whom a mask is for, and what its errors are, against loops written out."""

import numpy as np
import pytest
import torch

from recipes.studies.looking.oracle import Climber, oracle, swap_cells
from tests.refusals import refused
from tests.studies.test_looking import STEPS, BySign, make_network, policy, queries
from torchrl_sparse import keys

__all__ = ["make_network", "policy", "queries"]

BLOCKS = 6


@pytest.fixture
def encoded(policy, queries):
    policy.plan = BySign()
    return policy.module["encode"](queries.clone())


def test_a_swap_computes_as_many_blocks_of_each_type_and_leaves_the_first_step():
    rng = np.random.default_rng(0)
    mask = torch.rand(5, BLOCKS, generator=torch.Generator().manual_seed(0)) < 0.5
    mask[0] = False
    changed = []
    for _ in range(200):
        swapped = swap_cells(mask, rng)
        assert not swapped[0].any()
        for kind in range(3):
            assert swapped[:, kind::3].sum() == mask[:, kind::3].sum()
        changed.append(int((swapped != mask).sum()))
        mask = swapped
    assert min(changed) == 2  # one for one
    assert max(changed) > 2


@pytest.mark.parametrize("value", [False, True])
def test_where_nothing_can_be_swapped_nothing_is(value):
    mask = torch.full((4, BLOCKS), value)
    mask[0] = False
    assert torch.equal(swap_cells(mask, np.random.default_rng(0)), mask)


def test_errors_are_those_of_the_executed_actions_to_dense_on_the_same_noise(policy, encoded):
    climber = Climber(policy, encoded, draws=3, n_action_steps=4, seed=5)
    masks = BySign.masks(policy.plan, encoded[keys.COND])
    seeds = torch.randint(2**62, (36, 1), generator=torch.Generator().manual_seed(5)).view(12, 3)
    for query, found in enumerate(climber.errors(masks)):
        differences = []
        for seed in seeds[query]:
            noise, cond = policy.sample_noise(seed[None]), encoded[keys.COND][query : query + 1]
            with torch.no_grad():
                pruned, dense = (policy.denoise(noise, cond, mask) for mask in (masks[query][None], None))
            differences.append((pruned - dense)[:, 1:5].abs().mean())
        assert found.item() == pytest.approx(torch.stack(differences).mean().item(), rel=1e-4)


def test_each_group_climbs_to_the_mask_that_its_own_queries_want(policy, encoded, monkeypatch):
    wanted = BySign.masks(policy.plan, encoded[keys.COND])
    climber = Climber(policy, encoded, draws=1, n_action_steps=4, seed=0)
    monkeypatch.setattr(climber, "errors", lambda masks: (masks != wanted).float().mean(dim=(1, 2)))
    start = torch.zeros(STEPS, BLOCKS, dtype=torch.bool)
    start[1, :3], start[2] = True, True  # as many of each type as either wants, or half
    start[3, :3] = True
    two = (encoded[keys.COND][:, 0, 0] > 0).long()
    each = climber.climb(start, torch.arange(12), 150)
    pair = climber.climb(start, two, 150)
    one = climber.climb(start, torch.zeros(12, dtype=torch.long), 150)
    late = wanted.sum(dim=(1, 2)) == start.sum()
    assert late.any()
    assert torch.equal(each[late], wanted[late])
    assert torch.equal(pair[late], wanted[late])
    assert all(torch.equal(mask, one[0]) for mask in one)
    assert not torch.equal(one[late], wanted[late])


def test_on_the_noise_that_it_climbs_on_no_mask_gets_worse(policy, queries):
    policy.plan = BySign()
    told = []
    found = oracle(policy, queries, attempts=20, draws=2, n_action_steps=4, on_attempt=lambda: told.append(1))
    assert (found.queries, found.episodes, len(told)) == (12, 3, 60)
    assert found.seen["query"] < found.seen["start"]
    assert max(found.seen["all"], found.seen["phase"]) <= found.seen["start"]
    assert found.error["start"] != found.seen["start"]  # other noise
    mean, low, high = found.over_all["query"]
    assert low <= mean <= high
    assert mean == pytest.approx(found.error["query"] - found.error["all"], abs=1e-6)
    again = oracle(policy, queries, attempts=20, draws=2, n_action_steps=4)
    assert again == found
    with refused("queries"):
        oracle(policy, queries[:4], attempts=1)
