"""The pruner: its masks, what it refuses, what it costs, and its files."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from tests.blocks.conftest import COND_DIM, NUM_LAYERS, NUM_STEPS, OBS_STEPS
from tests.refusals import refused
from torchrl_sparse.blocks.mask import NetworkSizes, query_flops
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner, rate_threshold
from torchrl_sparse.keys import COND, PRUNE_MASK, PRUNE_RATE

NUM_BLOCKS = 3 * NUM_LAYERS
SPEC = PlanSpec(NUM_STEPS, NUM_LAYERS, policy="8d1f", sampler="ddim")
TIMESTEPS = list(range(90, -1, -10))


def make_pruner(rate_range=None, unseen=0, **info):
    torch.manual_seed(0)
    options = {"rate_input": rate_range is not None, "unseen": unseen}
    network = PrunerNetwork(TIMESTEPS, NUM_BLOCKS, (OBS_STEPS, COND_DIM), **options)
    return SAGPruner(network, PrunerInfo("8d1f", "ddim", 0.7, rate_range, **info))


def observations(rows=16):
    generator = torch.Generator().manual_seed(1)
    return 5 * torch.randn(rows, OBS_STEPS, COND_DIM, generator=generator)


def plan(pruner, cond, rate=None):
    pruner.bind(SPEC)
    td = TensorDict({COND: cond}, cond.shape[:-2])
    if rate is not None:
        td[PRUNE_RATE] = torch.full((*td.batch_size, 1), rate)
    return pruner(td)[PRUNE_MASK]


def test_masks_depend_on_the_observation_and_spare_the_first_step():
    masks = plan(make_pruner(), observations())
    assert masks.shape == (16, NUM_STEPS, NUM_BLOCKS)
    assert not masks[:, 0].any()
    assert masks.float().var(dim=0).sum() > 0


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("rate", [None, 0.5])
def test_pruning_is_preferred_by_the_difference_of_the_logits(rate, training):
    network = make_pruner((0.3, 0.8) if rate else None).network.train(training)
    rate = None if rate is None else torch.full((16, 1), rate)
    for grad in (True, False):
        with torch.set_grad_enabled(grad):
            keep, prune = network(observations(), rate).unbind(-1)
            torch.testing.assert_close(network.prune_logits(observations(), rate), prune - keep)


def test_a_row_equals_the_row_alone_whatever_the_batch_dimensions():
    pruner, cond = make_pruner(), observations()
    together = plan(pruner, cond.view(4, 4, OBS_STEPS, COND_DIM)).flatten(0, 1)
    assert torch.equal(together, torch.stack([plan(pruner, row) for row in cond]))


def test_the_observation_free_part_is_kept_in_evaluation_mode_and_renewed_after_training():
    network = make_pruner().network
    with torch.no_grad():
        kept = network.cells()
        assert network.cells() is kept
        network.train()
        for parameter in network.token.parameters():
            parameter.add_(1.0)
        network.eval()
        assert not torch.allclose(network.cells(), kept)


def test_kept_and_fresh_logits_are_equal():
    network = make_pruner().network
    with torch.no_grad():
        kept = network(observations())
        network.train()
        torch.testing.assert_close(network(observations()), kept, rtol=0, atol=1e-6)


def test_a_pruner_of_default_size_costs_less_than_three_thousandths_of_the_dense_policy():
    sizes = NetworkSizes(8, horizon=10, n_obs_steps=2, width=256, input_dim=10, output_dim=10, cond_dim=19)
    dense = query_flops(sizes, torch.zeros(100, 24, dtype=torch.bool))
    pruner = PrunerNetwork(range(99, -1, -1), 24, (2, 19))
    assert 2 * pruner.macs_per_query < 0.003 * dense


def test_the_count_of_macs_is_that_of_the_matrix_products():
    from torch.utils.flop_counter import FlopCounterMode

    network = make_pruner().network
    with torch.no_grad():
        network.cells()
        with FlopCounterMode(display=False) as counter:
            network(observations(1))
    assert counter.get_total_flops() == 2 * network.macs_per_query


def test_the_rate_is_an_input_that_falls_back_to_the_default():
    pruner, cond = make_pruner(rate_range=(0.5, 0.97)), observations()
    assert pruner.in_keys == [COND, PRUNE_RATE]
    default = plan(pruner, cond)
    asked = plan(pruner, cond, rate=0.7)
    assert torch.equal(default, asked)
    with torch.no_grad():
        differ = pruner.network(cond, torch.full((16, 1), 0.5)) != pruner.network(
            cond, torch.full((16, 1), 0.97)
        )
    assert differ.any()
    pruner.rate = 0.9
    assert pruner.rate == 0.9


@pytest.mark.parametrize("rate", [0.5, 0.62, 0.85])
def test_every_query_keeps_the_rate_that_it_asks_for(rate):
    pruner = make_pruner(rate_range=(0.5, 0.97))
    masks = plan(pruner, observations(), rate=rate)
    assert (masks.sum(dim=(1, 2)) == round(rate * NUM_STEPS * NUM_BLOCKS)).all()
    assert (plan(pruner, observations(), rate=0.97).sum(dim=(1, 2)) == (NUM_STEPS - 1) * NUM_BLOCKS - 1).all()


def test_a_shift_of_all_logits_has_no_gradient():
    logits = torch.randn(2, NUM_STEPS, NUM_BLOCKS, requires_grad=True)
    (logits - rate_threshold(logits, torch.tensor([[0.5], [0.8]])))[:, 1:].sum().backward()
    assert logits.grad.sum().abs() < 1e-4


@pytest.mark.parametrize("rate", [0.4, 0.98, float("nan")])
def test_a_rate_out_of_range_is_refused(rate):
    pruner, cond = make_pruner(rate_range=(0.5, 0.97)), observations(1)
    with refused("rate"):
        pruner.rate = rate
    with refused("('diffusion', 'prune_rate')"):
        plan(pruner, cond, rate=rate)
    with refused("rate"):
        make_pruner().rate = 0.8


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (PlanSpec(NUM_STEPS, NUM_LAYERS, "77aa", "ddim"), "policy fingerprint '8d1f', got '77aa'"),
        (PlanSpec(20, NUM_LAYERS, "8d1f", "ddim"), "num_inference_steps 10, got 20"),
        (PlanSpec(NUM_STEPS, 8, "8d1f", "ddim"), "num_layers 2, got 8"),
        (PlanSpec(NUM_STEPS, NUM_LAYERS, "8d1f", "ddpm"), "sampler 'ddim', got 'ddpm'"),
    ],
)
def test_another_policy_or_sampler_is_refused(spec, message):
    with refused("SAGPruner"):
        make_pruner().bind(spec)


@pytest.mark.parametrize("rate_range", [None, (0.5, 0.97)])
def test_columns_that_are_not_to_be_seen_change_nothing(rate_range):
    pruner = make_pruner(rate_range, unseen=2)
    network, cond = pruner.network, observations()
    other = cond + 9 * torch.randn(cond.shape) * (torch.arange(COND_DIM) < 2)
    rate = None if rate_range is None else torch.rand(len(cond), 1)
    with torch.no_grad():
        compiled = network.prune_logits(cond, rate)
        torch.testing.assert_close(network.prune_logits(other, rate), compiled, rtol=0, atol=1e-5)
        keep, prune = network(cond, rate).unbind(-1)
        torch.testing.assert_close(prune - keep, compiled, rtol=1e-5, atol=1e-5)
        assert torch.equal(network(other, rate), network(cond, rate))
    assert (network.prune_logits(cond[:1], rate if rate is None else rate[:1]) != compiled[1:]).any()


@pytest.mark.parametrize("unseen", [-1, COND_DIM, True, 1.0])
def test_columns_that_cannot_be_left_out_are_refused(unseen):
    with refused("unseen"):
        PrunerNetwork(TIMESTEPS, NUM_BLOCKS, (OBS_STEPS, COND_DIM), unseen=unseen)


def test_an_observation_of_another_shape_is_refused():
    with refused("('diffusion', 'cond')"):
        plan(make_pruner(), torch.zeros(1, 2, 6))


@pytest.mark.parametrize("unseen", [0, 2])
@pytest.mark.parametrize("rate_range", [None, (0.5, 0.97)])
def test_files_bring_back_the_same_pruner(tmp_path, rate_range, unseen):
    pruner = make_pruner(rate_range, unseen=unseen, reuse="block", settings={"updates": 3})
    pruner.save_pretrained(tmp_path / "sag")
    loaded = SAGPruner.from_pretrained(tmp_path / "sag")
    assert loaded.info == pruner.info
    assert loaded.reuse == "block"
    assert torch.equal(plan(loaded, observations()), plan(pruner, observations()))
    assert sorted(file.name for file in (tmp_path / "sag").iterdir()) == ["config.json", "pruner.safetensors"]


def damaged(config, path, how):
    if how == "no weights":
        (path / "pruner.safetensors").unlink()
    elif how == "truncated weights":
        data = (path / "pruner.safetensors").read_bytes()
        (path / "pruner.safetensors").write_bytes(data[: len(data) // 2])
    elif how == "truncated config":
        (path / "config.json").write_text(json.dumps(config)[:50])
    else:
        changes = {
            "format": {"format": "torchrl_sparse.sag/9"},
            "rate": {"rate": 1.5},
            "reuse": {"reuse": "layer"},
            "unknown field": {"colour": "red"},
            "size": {"network": {**config["network"], "hidden": 32}},
            "network": {"network": {"depth": 3}},
        }
        (path / "config.json").write_text(json.dumps({**config, **changes[how]}))


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ("no weights", FileNotFoundError, "expected a file .*pruner.safetensors"),
        ("truncated weights", ValueError, "pruner.safetensors: expected a complete safetensors file"),
        ("truncated config", ValueError, "config.json: expected a complete JSON file"),
        (
            "format",
            ValueError,
            "config.json: format: expected 'torchrl_sparse.sag/1', got 'torchrl_sparse.sag/9'",
        ),
        ("rate", ValueError, r"config.json: .*rate: expected a prune rate in \(0, 1\), got 1.5"),
        ("reuse", ValueError, "config.json: reuse: expected .*got 'layer'"),
        ("unknown field", ValueError, "config.json: colour: expected no such key"),
        ("size", ValueError, "pruner.safetensors: fuse_obs.weight: expected shape .32, 64., got .64, 64."),
        ("network", ValueError, "config.json: .*'depth'"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, how, error, message):
    make_pruner().save_pretrained(tmp_path)
    damaged(json.loads((tmp_path / "config.json").read_text()), tmp_path, how)
    with pytest.raises(error, match=f"(?s){message}"):
        SAGPruner.from_pretrained(tmp_path)


@pytest.mark.parametrize("dtype", [torch.int32, torch.uint8, torch.bool])
def test_weights_that_are_no_floating_point_numbers_are_refused_by_name(tmp_path, dtype):
    make_pruner().save_pretrained(tmp_path)
    tensors = load_file(tmp_path / "pruner.safetensors")
    save_file(tensors | {"obs.bias": tensors["obs.bias"].to(dtype)}, tmp_path / "pruner.safetensors")
    with refused("pruner.safetensors: obs.bias"):
        SAGPruner.from_pretrained(tmp_path)


def load(network, state):
    network.load_state_dict(state)


def assign(network, state):
    network.load_state_dict(state, assign=True)


def exchange(network, state):
    for name, value in state.items():
        module, _, weight = name.rpartition(".")
        setattr(network.get_submodule(module), weight, torch.nn.Parameter(value))
    network.eval()  # what follows from the weights is kept until then


@pytest.mark.parametrize("change", [load, assign, exchange])
def test_weights_that_changed_are_not_answered_with_the_old_ones(change):
    pruner, cond = make_pruner(), observations()
    before = plan(pruner, cond)
    other = {name: torch.randn_like(value) for name, value in pruner.network.state_dict().items()}
    change(pruner.network, other)
    fresh = make_pruner()
    fresh.network.load_state_dict(other)
    after = plan(pruner, cond)
    assert torch.equal(after, plan(fresh, cond))
    assert not torch.equal(after, before)


def test_rate_range_and_network_have_to_agree():
    network = PrunerNetwork(TIMESTEPS, NUM_BLOCKS, (OBS_STEPS, COND_DIM))
    with refused("rate_range"):
        SAGPruner(network, PrunerInfo("8d1f", "ddim", 0.7, (0.5, 0.97)))
