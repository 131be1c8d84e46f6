"""The planner's part of a policy: any module that writes a mask and its reuse rule."""

import pytest
import torch
from tensordict.nn import TensorDictModule

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


def plan_module(policy, rules):
    """A module that prunes half of every row, row i under ``rules[i]``."""

    def decide(cond):
        codes = torch.tensor([[REUSE_RULES.index(rule)] for rule in rules])
        return half_pruned(policy, len(cond)), codes

    return TensorDictModule(decide, in_keys=[keys.COND], out_keys=[keys.PRUNE_MASK, keys.REUSE])


def expected_chunk(policy, td, reuse):
    noise = policy.sample_noise(td[keys.SEED].flatten())
    actions = denoise(policy.network, policy.sampler, noise, td[keys.COND], td[keys.PRUNE_MASK], reuse=reuse)
    return policy.normalizer.unnormalize_action(actions[:, policy.n_obs_steps - 1 :])


@pytest.mark.parametrize("rule", REUSE_RULES)
def test_another_module_brings_its_own_rule(policy, rule):
    policy.module["plan"] = plan_module(policy, [rule] * 3)
    with torch.no_grad():
        td = policy(request(3))
        torch.testing.assert_close(td[keys.CHUNK], expected_chunk(policy, td, rule), atol=1e-5, rtol=0)


@pytest.mark.parametrize("engine", ["reference", "torch", "auto"])
def test_rows_of_a_batch_may_have_different_rules(policy, engine):
    policy.engine = engine
    rules = ["type", "block", "single", "type", "block"]
    policy.module["plan"] = plan_module(policy, rules)
    with torch.no_grad():
        td = policy(request(5))
        for row, rule in enumerate(rules):
            expected = expected_chunk(policy, td[row : row + 1], rule)
            torch.testing.assert_close(td[keys.CHUNK][row : row + 1], expected, atol=1e-5, rtol=0)
    assert (td[keys.CHUNK][0] - expected_chunk(policy, td, "block")[0]).abs().max() > 1e-3


def test_a_rule_that_is_none_or_missing_is_named(policy):
    module = plan_module(policy, ["block"] * 2)
    policy.module["plan"] = module
    with pytest.raises(ValueError, match=r"\('diffusion', 'reuse'\): expected an index of .* got \[0, 3\]"):
        policy.module["denoise"](
            module(policy.module["encode"](request(2))).set(keys.REUSE, torch.tensor([[0], [3]]))
        )
    mask_alone = TensorDictModule(
        lambda cond: half_pruned(policy, len(cond)), in_keys=[keys.COND], out_keys=[keys.PRUNE_MASK]
    )
    policy.module["plan"] = mask_alone
    with pytest.raises(KeyError, match=r"expected the key \('diffusion', 'reuse'\), got"):
        policy(request(2))


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
    with pytest.raises(
        ValueError, match=r"^PrunesTheFirstStep: prune mask: expected row 0 .* got True for layers"
    ):
        policy(request(2))
    wide = torch.zeros(2, policy.num_inference_steps, 99, dtype=torch.bool)
    policy.module["plan"] = TensorDictModule(
        lambda cond: (wide, torch.zeros(2, 1, dtype=torch.int64)), [keys.COND], [keys.PRUNE_MASK, keys.REUSE]
    )
    with pytest.raises(
        ValueError, match=r"^TensorDictModule: prune mask: expected shape \[2, 8, 6\].*\[2, 8, 99\]"
    ):
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
