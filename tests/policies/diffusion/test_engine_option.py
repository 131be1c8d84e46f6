"""The engine option of a policy: the same actions from every engine, and the reference where gradients are needed."""

import copy

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler, TransformerForDiffusion, Uniform, keys
from torchrl_sparse.blocks.engine import (
    ENGINES as ENGINE_TABLE,
    EngineEntry,
    ReferenceEngine,
    make_engine,
    native_available,
)

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
    with refused("engine"):
        DiffusionPolicy.from_pretrained(tmp_path, engine="turbo")


@pytest.mark.skipif(not native_available()[0], reason="only the native engine rounds")
def test_rounded_weights_are_saved_as_such_and_given_up_for_an_exact_engine(policy, tmp_path):
    policy.engine = "native_int8"
    policy.save_pretrained(tmp_path)
    rounded, exact = (
        DiffusionPolicy.from_pretrained(tmp_path, engine=engine) for engine in ("auto", "native")
    )
    assert (rounded.engine, exact.engine) == ("native_int8", "native")
    answers = [loaded(request(3))[keys.CHUNK] for loaded in (rounded, exact)]
    assert not torch.equal(*answers)
    torch.testing.assert_close(
        answers[0], policy(request(3))[keys.CHUNK], atol=5e-2, rtol=0
    )  # fp16 on the way


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


def assign_state(network):
    network.load_state_dict({name: 1.5 * value for name, value in network.state_dict().items()}, assign=True)


def replace_a_parameter(network):
    network.head.bias = torch.nn.Parameter(network.head.bias.detach() + 1.0)


def replace_a_module(network):
    other = copy.deepcopy(network.decoder.layers[1])
    other.linear2.bias.data[20:] += 1.0
    network.decoder.layers[1] = other


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("change", [assign_state, replace_a_parameter, replace_a_module])
def test_weights_that_are_exchanged_change_the_actions(policy, engine, change):
    policy.engine = engine
    before = policy(request(2))[keys.CHUNK]
    change(policy.network)
    changed = policy(request(2))[keys.CHUNK]
    policy.engine = "reference"
    torch.testing.assert_close(changed, policy(request(2))[keys.CHUNK], atol=1e-5, rtol=0)
    assert (changed - before).abs().max() > 1e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_refresh_reads_weights_that_were_written_behind_all_records(policy, engine):
    policy.engine = engine
    before = policy(request(2))[keys.CHUNK]
    policy.network.decoder.layers[1].linear2.bias.data[20:] += 1.0
    policy.refresh()
    changed = policy(request(2))[keys.CHUNK]
    policy.engine = "reference"
    torch.testing.assert_close(changed, policy(request(2))[keys.CHUNK], atol=1e-5, rtol=0)
    assert (changed - before).abs().max() > 1e-3


@pytest.mark.skipif("native" not in ENGINES, reason="the native engine was not built")
def test_refresh_reads_anew_what_another_policy_of_the_network_has_packed(policy):
    policy.engine = "native"
    before = policy(request(2))[keys.CHUNK]
    policy.network.decoder.layers[1].linear2.bias.data[20:] += 1.0
    other = policy.with_plan(None)
    other.refresh()
    changed = other(request(2))[keys.CHUNK]
    assert torch.equal(policy(request(2))[keys.CHUNK], changed)
    assert (changed - before).abs().max() > 1e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_weights_that_were_moved_to_no_device_are_refused_by_name(policy, engine):
    policy.engine = engine
    policy(request(2))
    td = policy.module["plan"](policy.module["encode"](request(2)))
    policy.network.to("meta")
    with pytest.raises(ValueError, match=r"on the meta device|the network is on meta"):
        policy.module["denoise"](td)


@pytest.mark.parametrize("made_within", [False, True])
@pytest.mark.parametrize("engine", ENGINES)
def test_autocast_around_a_policy_works(policy, engine, made_within):
    """Engines compute in the weights' own type whatever autocast says; the reference is PyTorch and follows it."""
    policy.engine, policy.plan = engine, Uniform(3)
    with torch.no_grad():
        expected = None if made_within else policy(request(3))[keys.CHUNK]
        with torch.autocast("cpu"):
            within = policy(request(3))[keys.CHUNK]
        if expected is None:
            expected = policy(request(3))[keys.CHUNK]
    assert within.dtype == torch.float32
    torch.testing.assert_close(within, expected, atol=0.3 if engine == "reference" else 0, rtol=0)


class HalfWay:
    """An engine from outside the package: half of what the reference answers."""

    name, detail = "half", "a toy"

    def __init__(self, network, sampler):
        self._reference = ReferenceEngine(network, sampler)

    def denoise(self, *query):
        return 0.5 * self._reference.denoise(*query)


@pytest.fixture
def half_engine(monkeypatch):
    def only_small(network):
        return network.n_emb <= 32, "it is for small networks"

    monkeypatch.setitem(ENGINE_TABLE, "half", EngineEntry(HalfWay, only_small))


def test_an_engine_from_outside_is_one_line_in_the_table(policy, half_engine):
    policy.engine = "reference"
    td = policy(request(3))
    policy.engine = "half"
    half = policy.normalizer.normalize_action(policy(request(3))[keys.CHUNK])
    torch.testing.assert_close(half, 0.5 * policy.normalizer.normalize_action(td[keys.CHUNK]))
    assert policy.engine == "half"
    assert policy.engine_info() == "half: a toy"
    policy.engine = "auto"
    assert "half" not in policy.engine_info()


def test_where_an_engine_from_outside_does_not_apply_it_says_why(half_engine):
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
    with refused("half engine"):
        make_engine("half", TransformerForDiffusion(**sizes, n_layer=1, n_emb=64), Sampler())


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
