"""A policy call in one native call is the call of the stages: the same keys, the same bits."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.native import native_available
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.policies.diffusion import policy as module
from torchrl_sparse.policies.diffusion.shortcut import answer_directly
from torchrl_sparse.policies.diffusion.warm_start import WarmStart

from .test_export import Half, Looks, make_policy

AVAILABLE, REASON = native_available()
pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)


class OddSteps(Half):
    """Its mask is one column, which lies in memory once."""

    def mask(self, spec):
        return (torch.arange(spec.num_inference_steps) % 2 == 1)[:, None].expand(-1, spec.num_blocks)


def make_query(batch):
    state = torch.randn(*batch, 2, 5, generator=torch.Generator().manual_seed(0))
    episode = {
        name: torch.arange(1, 1 + torch.Size(batch).numel()).view(*batch, 1) for name in ("seed", "step")
    }
    return TensorDict({"history": {"state": state}, "episode": episode}, batch)


def direct(policy, data):
    return answer_directly(0.0, policy._parts, data, *policy.module.values())


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("noise", ["torch", "philox"])
@pytest.mark.parametrize("plan", [None, "type", "block"])
@pytest.mark.parametrize("batch", [(1,), (), (3,), (2, 2)])
def test_the_same_keys_and_bits(batch, plan, noise, frozen, monkeypatch):
    policy = make_policy(plan=plan and Half(plan))
    policy.noise = noise
    if frozen:
        policy.freeze()
    with torch.no_grad():
        data = make_query(batch)
        assert direct(policy, data)
        got = policy(make_query(batch))
        monkeypatch.setattr(module, "answer_directly", lambda *_: False)
        expected = policy(make_query(batch))
    assert set(data.keys(True, True)) == set(got.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert got[key].dtype == expected[key].dtype
        assert got[key].shape == expected[key].shape
        if key != keys.LATENCY:
            assert torch.equal(got[key], expected[key])
    assert got[keys.LATENCY] > 0 if batch == () else got[keys.LATENCY].min() > 0


def test_a_mask_that_is_spread_is_read_as_it_is(monkeypatch):
    policy = make_policy(plan=OddSteps("block"))
    assert not policy.plan.static_mask.is_contiguous()
    got = policy(make_query((2,)))
    monkeypatch.setattr(module, "answer_directly", lambda *_: False)
    assert torch.equal(got[keys.CHUNK], policy(make_query((2,)))[keys.CHUNK])


def test_masks_of_rows_can_be_written_to_and_change_no_other():
    policy = make_policy(plan=Half("block"))
    data = policy(make_query((2,)))
    data[keys.PRUNE_MASK][0] = True
    again = policy(make_query((2,)))
    assert not again[keys.PRUNE_MASK].all()
    assert torch.equal(data[keys.PRUNE_MASK][1], again[keys.PRUNE_MASK][1])


@pytest.mark.parametrize(
    "why",
    [
        "training",
        "looks at the observation",
        "hook",
        "engine",
        "warm start",
        "double",
        "gradients",
        "turned",
        "not finite",
        "shape",
        "missing",
    ],
)
def test_where_the_stages_have_to_run_it_leaves_everything_alone(why):
    policy, data = make_policy(plan=Looks() if why == "looks at the observation" else None), make_query((2,))
    state = data["history", "state"]
    if why == "training":
        policy.train()
    if why == "hook":
        policy.module["plan"].register_forward_hook(lambda *_: None)
    if why == "warm start":
        policy.start = WarmStart(1)
    if why == "engine":
        policy.engine = "torch"
    changed = {
        "double": state.double(),
        "gradients": state.clone().requires_grad_(),
        "turned": state.transpose(1, 2).contiguous().transpose(1, 2),
        "not finite": torch.full_like(state, torch.nan),
        "shape": state.repeat(1, 2, 1),
    }
    data["history", "state"] = changed.get(why, state)
    if why == "missing":
        del data["history"]
    before = set(data.keys(True, True))
    assert not direct(policy, data)
    assert set(data.keys(True, True)) == before


def test_a_change_of_weights_or_of_the_normaliser_is_seen():
    policy = make_policy()
    before = policy(make_query((1,)))[keys.CHUNK]
    policy.normalizer.action_offset += 1
    shifted = policy(make_query((1,)))[keys.CHUNK]
    assert not torch.allclose(before, shifted)
    with torch.no_grad():
        policy.network.head.bias += 1
    assert not torch.allclose(shifted, policy(make_query((1,)))[keys.CHUNK])


def test_a_planner_with_a_forward_of_its_own_is_asked():
    class Counts(Half):
        calls = 0

        def forward(self, tensordict):
            self.calls += 1
            return Planner.forward(self, tensordict)

    plan = Counts("block")
    make_policy(plan=plan)(make_query((1,)))
    assert plan.calls == 1
