"""The engine option of a policy: the same actions from every engine, and the reference where gradients are needed."""

import copy

import pytest
import torch

from torchrl_sparse import DiffusionPolicy, Uniform, keys
from torchrl_sparse.blocks.engine import native_available

from .test_policy import request

ENGINES = ["reference", "torch", "auto"] + ["native"] * native_available()[0]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("plan", [None, Uniform(3)])
def test_every_engine_gives_the_same_actions(policy, engine, plan):
    if plan is not None:
        policy.plan = plan
    policy.engine = "reference"
    expected = policy(request(3))
    policy.engine = engine
    td = policy(request(3))
    torch.testing.assert_close(td[keys.CHUNK], expected[keys.CHUNK], atol=1e-5, rtol=0)
    assert torch.equal(td[keys.FLOPS], expected[keys.FLOPS])
    assert policy.engine == engine
    assert policy.engine_info().startswith(("native: ", "torch: ") if engine == "auto" else f"{engine}: ")


def test_the_option_is_taken_by_the_constructors(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    assert DiffusionPolicy.from_pretrained(tmp_path).engine == "auto"
    assert DiffusionPolicy.from_pretrained(tmp_path, engine="torch").engine_info().startswith("torch: cpu")
    with pytest.raises(ValueError, match=r"engine: expected one of .* got 'turbo'"):
        DiffusionPolicy.from_pretrained(tmp_path, engine="turbo")


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("through_data", [False, True])
def test_weights_that_change_change_the_actions(policy, engine, through_data):
    policy.engine = engine
    policy(request(2))
    for parameter in policy.network.parameters():
        # diffusers' weight average writes through .data, which leaves a parameter's version as it was.
        (parameter.data if through_data else parameter.detach()).mul_(1.5)
    changed = policy(request(2))[keys.CHUNK]
    policy.engine = "reference"
    torch.testing.assert_close(changed, policy(request(2))[keys.CHUNK], atol=1e-5, rtol=0)


def test_gradients_flow_in_training_mode_and_to_the_observations(policy):
    policy.train()
    policy(request(2))[keys.CHUNK].sum().backward()
    assert policy.network.head.weight.grad.abs().sum() > 0
    policy.eval()
    td = request(2)
    td[keys.HISTORY_STATE].requires_grad_()
    policy(td)[keys.CHUNK].sum().backward()
    assert td[keys.HISTORY_STATE].grad.abs().sum() > 0
    assert not policy(request(2))[keys.CHUNK].requires_grad


def test_a_copy_runs_on_an_engine_of_its_own(policy):
    expected = policy(request(2))[keys.CHUNK]
    twin = copy.deepcopy(policy)
    with torch.no_grad():
        policy.network.head.weight.zero_()
    assert torch.equal(twin(request(2))[keys.CHUNK], expected)


def test_block_costs_are_those_of_the_engine(policy):
    policy.engine = "reference"
    published = policy.block_costs()
    policy.engine = "torch"
    assert policy.block_costs()["CA"].flops < published["CA"].flops / 2
    assert policy.block_costs()["FFN"].flops == published["FFN"].flops
