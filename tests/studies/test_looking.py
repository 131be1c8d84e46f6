"""Whether a pruner looks, told of pruners that do and that do not; and how alike outputs are, against loops written out."""

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import cosine_similarity

from recipes.studies.looking.following import looking
from recipes.studies.looking.reuse_sources import reuse_sources, source_similarity
from tests.fixtures.diffusion import SIZES, make_network
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, keys
from torchrl_sparse.blocks.planner import Planner

__all__ = ["make_network"]

LAYERS, STEPS = 2, 4


class BySign(Planner):
    """Prunes the second half of the chain where the first observed number is positive, and the first half elsewhere."""

    def masks(self, cond):
        step = torch.arange(self.spec.num_inference_steps)
        late = (cond[:, 0, 0] > 0)[:, None] == (step >= STEPS // 2)
        late[:, 0] = False
        return late[..., None].repeat(1, 1, self.spec.num_blocks)


class Always(BySign):
    """The same, as if all numbers were positive."""

    def masks(self, cond):
        return super().masks(torch.ones_like(cond))


@pytest.fixture
def policy(make_network):
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(10), torch.zeros(10))
    return DiffusionPolicy(make_network(n_layer=LAYERS), normalizer, sampler=Sampler("ddim", STEPS))


@pytest.fixture
def queries():
    """Three episodes of four policy calls; in the first half of each the first observed number is positive."""
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(12, 2, SIZES["cond_dim"], generator=generator)
    state[..., 0] = torch.tensor([1.0, 1, -1, -1] * 3)[:, None]
    query = {
        keys.HISTORY_STATE: state,
        keys.EPISODE_SEED: torch.arange(3).repeat_interleave(4)[:, None],
        keys.EPISODE_STEP: torch.arange(4).repeat(3)[:, None],
        keys.ELAPSED: torch.tensor([0, 8, 8, 8] * 3)[:, None],
    }
    return TensorDict(query, [12])


def test_masks_that_follow_the_observation_are_told_with_their_phases(policy, queries):
    policy.plan = BySign()
    found = looking(policy, queries, n_action_steps=4, phases=2)
    assert (found.queries, found.episodes) == (12, 3)
    assert found.varying == found.varying_in_episode == pytest.approx(0.75)  # all but the first step
    first, second = torch.tensor(found.phases)
    assert torch.equal(first[2:], torch.full_like(first[2:], 0.5))
    assert torch.equal(second, -first)
    assert not first[0].any()
    assert first[1].eq(-0.5).all()


def test_errors_are_those_of_the_actions_under_each_mask(policy, queries):
    policy.plan = BySign()
    found = looking(policy, queries, n_action_steps=4, phases=2)
    with torch.no_grad():
        pruned = policy(queries.clone())[keys.CHUNK]
        policy.plan = None
        dense = policy(queries.clone())[keys.CHUNK]
    assert found.error["own"] == pytest.approx((pruned - dense)[:, :4].abs().mean().item(), rel=1e-4)
    mean, low, high = found.own_minus_mean
    assert low <= mean <= high
    assert mean == pytest.approx(found.error["own"] - found.error["mean"], abs=1e-6)


def test_a_mask_that_is_always_the_same_does_not_look(policy, queries):
    policy.plan = Always()
    found = looking(policy, queries, n_action_steps=4)
    assert found.varying == found.differing == 0
    assert found.error["own"] == found.error["mean"] == found.error["others"]
    assert not torch.tensor(found.phases).any()
    with refused("queries"):
        looking(policy, queries[:4])


def test_similarities_are_those_of_what_a_pruned_block_would_read():
    generator = torch.Generator().manual_seed(0)
    now, before = torch.randn(2, 3 * LAYERS, STEPS, 7, generator=generator).unbind(0)
    found = source_similarity(now, before)
    latest, own = {}, {}
    for step in range(STEPS):
        for block in range(3 * LAYERS):
            for row, source in enumerate((own.get(block), latest.get(block % 3), before[block, step])):
                alike = 0.0 if source is None else cosine_similarity(now[block, step], source, dim=0).item()
                assert found[row, block, step].item() == pytest.approx(alike, abs=1e-5)
            own[block] = latest[block % 3] = now[block, step]


def test_a_query_is_only_compared_with_one_of_its_episode(policy, queries):
    whole = torch.tensor(reuse_sources(policy, queries).query)
    parts = [torch.tensor(reuse_sources(policy, part).query) for part in queries.split(4)]
    torch.testing.assert_close(whole, torch.stack(parts).mean(dim=0))
    queries[keys.ELAPSED] = torch.zeros(12, 1, dtype=torch.long)
    with refused("queries"):
        reuse_sources(policy, queries)
