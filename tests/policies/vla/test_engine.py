"""The engine option of a VLA: the same actions from every engine, and PyTorch where another cannot serve."""

import copy
import pickle
from importlib.util import find_spec

import pytest
import torch
from torch import nn

from tests.refusals import refused
from tests.tokens.helpers import KEEP_ALL, PRUNERS, later, make_grouped_policies, make_policy, query
from torchrl_sparse import keys
from torchrl_sparse.networks.vla import openvino
from torchrl_sparse.networks.vla.adapters import add_adapters
from torchrl_sparse.networks.vla.network import VLANetwork

skips = pytest.mark.skipif(find_spec("openvino") is None, reason="without the extra openvino")


def needs_openvino(test):
    """Compiling takes a second or two each time."""
    return pytest.mark.full(skips(test))


CHUNK_RANGE = 2.0  # of normalised actions, which the identity leaves as they are
CLOSE = {"atol": 1e-5 * CHUNK_RANGE, "rtol": 0}


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield


def pair():
    """One policy in PyTorch and one of the same weights in OpenVINO."""
    reference, compiled = make_policy(), make_policy()
    reference.engine, compiled.engine = "torch", "openvino"
    return reference, compiled


@pytest.fixture(scope="module")
def pruned():
    """``pruned(make_pruner)``: such a pair, compiled once for all tests."""
    both = pair()
    return lambda make: [policy.with_pruner(make()) for policy in both]


def assert_same(found, expected):
    assert torch.equal(found[keys.TOKEN_DEPTH], expected[keys.TOKEN_DEPTH])
    assert torch.equal(found[keys.FLOPS], expected[keys.FLOPS])
    torch.testing.assert_close(found[keys.CHUNK], expected[keys.CHUNK], **CLOSE)


@needs_openvino
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("pruner", [None, *PRUNERS])
def test_actions_are_those_of_pytorch(pruned, pruner, batch):
    reference, compiled = pruned(PRUNERS.get(pruner, lambda: None))
    first = reference(query(batch))
    assert_same(compiled(query(batch)), first)
    assert_same(compiled(later(first)), reference(later(first)))


@needs_openvino
@pytest.mark.parametrize("pruner", ["specprune", "sparsevlm", "fastv"])
def test_a_row_of_a_batch_is_the_row_alone(pruned, pruner):
    policy = pruned(PRUNERS[pruner])[1]
    together = policy(query(4))
    for row in range(4):
        alone = policy(query(4)[row : row + 1])
        torch.testing.assert_close(alone[keys.CHUNK][0], together[keys.CHUNK][row], **CLOSE)


@needs_openvino
@pytest.mark.parametrize("pruner", ["specprune", "fastv", "frame_difference"])
def test_pruning_nothing_is_dense(pruned, pruner):
    reference, compiled = pruned(KEEP_ALL[pruner])
    dense = reference.with_pruner(None)(query())
    torch.testing.assert_close(compiled(query())[keys.CHUNK], dense[keys.CHUNK], **CLOSE)


@needs_openvino
def test_heads_that_share_keys():
    reference, _ = make_grouped_policies(PRUNERS["specprune"])
    compiled = copy.deepcopy(reference)
    reference.engine, compiled.engine = "torch", "openvino"
    assert_same(compiled(query()), reference(query()))


@needs_openvino
def test_adapters_that_are_not_folded():
    reference, compiled = pair()
    for policy in (reference, compiled):
        torch.manual_seed(1)
        for weight in add_adapters(policy.network, 2).parameters():
            weight += 0.02 * torch.randn_like(weight)
    assert_same(compiled(query()), reference(query()))


@needs_openvino
@pytest.mark.parametrize(
    "change",
    [
        lambda network: network.head.fc2.weight.mul_(-1),
        lambda network: network.decoder.llama.layers[3].mlp.up_proj.weight.mul_(-1),
        lambda network: network.load_state_dict({k: 1.1 * v for k, v in network.state_dict().items()}),
        lambda network: setattr(network.projector, "fc1", nn.Linear(32, 128)),
    ],
)
def test_weights_that_change_after_compiling_change_the_actions(change):
    reference, compiled = pair()
    before = compiled(query())[keys.CHUNK]
    torch.manual_seed(2)
    change(compiled.network)
    reference.network.load_state_dict(compiled.network.state_dict())
    after = compiled(query())
    assert (after[keys.CHUNK] - before).abs().max() > 1e-4
    assert_same(after, reference(query()))


@needs_openvino
def test_refresh_reads_weights_that_were_written_behind_all_records():
    reference, compiled = pair()
    compiled(query())
    for policy in (reference, compiled):
        policy.network.head.fc2.weight.data[-1, -1] += 1
    compiled.refresh()
    assert_same(compiled(query()), reference(query()))


@needs_openvino
def test_policies_of_one_network_share_what_is_compiled(monkeypatch):
    policy = pair()[1]
    policy(query())
    monkeypatch.setattr(openvino, "_converted", lambda *args: pytest.fail("compiled again"))
    policy(query())
    policy.with_pruner(PRUNERS["random"]())(query())


@needs_openvino
def test_copies_and_pickles_carry_the_choice_alone():
    policy = pair()[1]
    expected = policy(query())
    for copied in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert copied.engine == "openvino"
        assert_same(copied(query()), expected)


@needs_openvino
def test_where_gradients_are_asked_for_or_somebody_looks_pytorch_runs():
    policy = pair()[1]
    assert policy.engine_info() == f"openvino: float32 on cpu, {torch.get_num_threads()} threads"
    seen = []
    hook = policy.network.decoder.llama.layers[0].mlp.register_forward_hook(lambda *call: seen.append(call))
    policy(query())
    assert seen
    assert "forward hooks" in policy.engine_info()
    hook.remove()
    with torch.enable_grad():
        assert policy(query())[keys.CHUNK].requires_grad
        assert "gradients" in policy.engine_info()


@needs_openvino
def test_outputs_stay_as_they_are_when_the_policy_is_called_again(pruned):
    policy = pruned(PRUNERS["fastv"])[1]
    first = policy(query())[keys.CHUNK]
    kept = first.clone()
    policy(query(seed=5))
    assert torch.equal(first, kept)


def test_auto_falls_back_and_says_why(monkeypatch):
    policy = make_policy()
    policy.network.bfloat16()
    assert policy.engine == "auto"
    if find_spec("openvino") is not None:
        assert "not openvino: expected float32 weights on a CPU, got torch.bfloat16" in policy.engine_info()
        policy.engine = "openvino"
        with refused("openvino engine"):
            policy(query())
    monkeypatch.setattr(openvino, "_is_installed", lambda: False)
    policy.engine = "auto"
    assert "torchrl-sparse[openvino]" in policy.engine_info()
    assert policy(query())[keys.CHUNK].isfinite().all()


def test_an_engine_whose_extra_is_missing_is_refused(monkeypatch):
    monkeypatch.setattr(openvino, "_is_installed", lambda: False)
    policy = make_policy()
    policy.engine = "openvino"
    with refused("openvino engine"):
        policy(query())


def test_an_unknown_engine_is_refused():
    with refused("engine"):
        make_policy().engine = "turbo"


def test_layers_that_nobody_reads_run_as_one():
    class Watching(VLANetwork):
        ran = []

        def run_layers(self, layers, *args):
            self.ran.append(layers)
            return super().run_layers(layers, *args)

    for pruner, expected in {
        "random": [(0, 1, 2, 3, 4, 5)],
        "fastv": [(0, 1), (2, 3, 4, 5)],
        "efficientvla": [(0, 1), (2, 4, 5)],
        "vla_cache": [(0,), (1,), (2,), (3,), (4,), (5,)],
    }.items():
        policy = make_policy(PRUNERS[pruner]())
        policy.engine, policy.network.__class__, Watching.ran = "torch", Watching, []
        policy(query())
        assert Watching.ran == expected
