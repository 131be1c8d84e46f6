"""The planner's part of a policy: a mask, and the rule by which pruned blocks reuse."""

import copy
import pickle

import pytest
import torch
from tensordict.nn import TensorDictModule

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.blocks import mask as masks
from torchrl_sparse.blocks.engine import base, denoise
from torchrl_sparse.blocks.mask import REUSE_RULES
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner

from .test_policy import request


def half_pruned(policy, rows):
    generator = torch.Generator().manual_seed(3)
    mask = torch.rand(1, policy.num_inference_steps, policy.num_blocks, generator=generator) < 0.5
    mask[:, 0] = False
    return mask.repeat(rows, 1, 1)


class HalfPruned(Planner):
    """Prunes half of every row."""

    def __init__(self, policy, reuse):
        super().__init__()
        self.reuse, self.mask = reuse, half_pruned(policy, 1)

    def masks(self, cond):
        return self.mask.repeat(len(cond), 1, 1)


def expected_chunk(policy, td, reuse):
    noise = policy.sample_noise(td[keys.SEED].flatten())
    actions = denoise(policy.network, policy.sampler, noise, td[keys.COND], td[keys.PRUNE_MASK], reuse=reuse)
    return policy.normalizer.unnormalize_action(actions[:, policy.n_obs_steps - 1 :])


@torch.no_grad()
@pytest.mark.parametrize("rule", REUSE_RULES)
@pytest.mark.parametrize("engine", ["reference", "torch", "auto"])
def test_a_query_reuses_by_the_rule_of_its_planner(policy, rule, engine):
    policy.engine, policy.plan = engine, HalfPruned(policy, rule)
    td = policy(request(3))
    torch.testing.assert_close(td[keys.CHUNK], expected_chunk(policy, td, rule), atol=1e-5, rtol=0)
    other = expected_chunk(policy, td, "type" if rule == "block" else "block")
    assert (td[keys.CHUNK] - other).abs().max() > 1e-3


@torch.no_grad()
def test_a_rule_that_is_changed_counts_from_the_next_query_on_in_copies_too(policy):
    policy.plan = HalfPruned(policy, "block")
    policy(request(3))
    policy.plan.reuse = "type"
    twin = copy.deepcopy(policy)
    for one in (policy, twin, pickle.loads(pickle.dumps(policy))):
        td = one(request(3))
        torch.testing.assert_close(td[keys.CHUNK], expected_chunk(policy, td, "type"), atol=1e-5, rtol=0)
    twin.plan.reuse = "single"
    td = twin(request(3))
    torch.testing.assert_close(td[keys.CHUNK], expected_chunk(policy, td, "single"), atol=1e-5, rtol=0)
    assert policy.plan.reuse == "type"
    policy.plan.reuse = "types"
    with refused("reuse"):
        policy(request(3))


def sag_pruner(policy):
    torch.manual_seed(1)
    network = PrunerNetwork(policy.sampler.timesteps.tolist(), policy.num_blocks, (2, 5))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return SAGPruner(network, PrunerInfo(policy.fingerprint, policy.sampler.name, rate=0.5))


@torch.no_grad()
def test_refresh_reaches_what_a_learned_planner_keeps(policy):
    policy.plan = sag_pruner(policy)
    before = policy(request(4))[keys.PRUNE_MASK]
    last = policy.plan.network.mlp[3]
    last.weight.data, last.bias.data = -last.weight, -last.bias
    policy.refresh()
    assert torch.equal(policy(request(4))[keys.PRUNE_MASK][:, 1:], ~before[:, 1:])


@torch.no_grad()
def test_what_a_learned_planner_keeps_is_not_rounded_by_autocast(policy):
    policy.plan = sag_pruner(policy)
    with torch.autocast("cpu"):
        policy(request(4))
    logits = policy.plan.network.prune_logits(policy(request(4))[keys.COND])
    expected = sag_pruner(policy).network.prune_logits(policy(request(4))[keys.COND])
    assert torch.equal(logits, expected)


class PrunesTheFirstStep(Planner):
    def masks(self, cond):
        return torch.ones(len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool)


@pytest.mark.parametrize("engine", ["reference", "torch", "auto"])
def test_a_wrong_mask_is_named_with_its_planner(policy, engine):
    policy.engine, policy.plan = engine, PrunesTheFirstStep()
    with refused("PrunesTheFirstStep: prune mask"):
        policy(request(2))
    wide = torch.zeros(2, policy.num_inference_steps, 99, dtype=torch.bool)
    policy.module["plan"] = TensorDictModule(lambda cond: wide, [keys.COND], [keys.PRUNE_MASK])
    with refused("TensorDictModule: prune mask"):
        policy(request(2))


@pytest.mark.parametrize("engine", ["reference", "torch", "auto"])
def test_a_mask_is_validated_once_a_query(policy, engine, monkeypatch):
    calls, validate = [], masks.validate_mask

    def counted(*args, **kwargs):
        calls.append(args)
        validate(*args, **kwargs)

    for module in (base, masks):
        monkeypatch.setattr(module, "validate_mask", counted)
    policy.engine = engine
    policy(request(2))
    # Compiled code takes a mask that does not depend on the observation as it was validated when it was bound.
    assert len(calls) == (0 if policy.engine_info().startswith("native") else 1)
