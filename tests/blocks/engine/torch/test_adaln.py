"""AdaLNEngine against the reference: masks, reuse rules and guidance."""

import copy
import pickle

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import calibrate
from torchrl_sparse.blocks.engine import denoise, make_engine
from torchrl_sparse.blocks.engine.costs import engine_block_costs, executed_flops
from torchrl_sparse.blocks.mask import query_flops
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler

SAMPLERS = [
    Sampler("ddpm", 10),
    Sampler("flow", 7),
    Sampler("flow", timesteps=[0.0, 0.3, 0.8]),
    Sampler("ddim", 10, prediction="sample"),
    Sampler("ddpm", 10, prediction="sample", clip_sample_range=None),
    Sampler("sde2m", 10),
]


def make(dtype=torch.float32, **changes):
    torch.manual_seed(0)
    sizes = {
        "input_dim": 3,
        "horizon": 6,
        "n_obs_steps": 2,
        "cond_dim": 5,
        "n_layer": 3,
        "n_head": 2,
        "n_emb": 32,
    }
    network = AdaLNTransformer(**sizes | {"time_dim": 8} | changes).eval().to(dtype)
    for layer in network.transformer_blocks:
        torch.nn.init.normal_(layer.modulation.weight, std=0.2)
    return network


def query(sampler, rows=4, dtype=torch.float32):
    noise = torch.randn(rows, sampler.num_inference_steps, 6, 3, dtype=dtype)
    mask = torch.rand(rows, sampler.num_inference_steps, 6) < 0.6
    mask[:, 0] = False
    mask[:, -1] = True  # a step without a computed block
    return noise, torch.randn(rows, 2, 5, dtype=dtype), mask


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda sampler: f"{sampler.name}_{sampler.prediction}")
@pytest.mark.parametrize("reuse", ["block", "type", "single"])
@torch.no_grad()
def test_masks_of_each_row_and_of_all(sampler, reuse):
    network = make()
    noise, cond, mask = query(sampler)
    engine = make_engine("torch", network, sampler)
    for tried in (None, mask, mask[:1].expand_as(mask)):
        expected = denoise(network, sampler, noise, cond, tried, reuse=reuse)
        torch.testing.assert_close(engine.denoise(noise, cond, tried, reuse), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {"rope_base": None},
        {"positions": True},
        {"rope_base": 50.0, "positions": True},
        {"dtype": torch.float64},
    ],
)
@torch.no_grad()
def test_positions_and_types(changes):
    network, sampler = make(**changes), Sampler("flow", 5)
    noise, cond, mask = query(sampler, dtype=network.like.dtype)
    found = make_engine("torch", network, sampler).denoise(noise, cond, mask)
    torch.testing.assert_close(found, denoise(network, sampler, noise, cond, mask), atol=1e-5, rtol=0)


@pytest.mark.parametrize("sampler", [Sampler("flow", 5), Sampler("ddim", 5, prediction="sample")], ids=str)
@torch.no_grad()
def test_a_guide_draws_and_holds(sampler):
    network = make()
    noise, cond, mask = query(sampler)
    pull = torch.zeros(4, 6, 1)
    pull[:, :2], pull[:, 2] = 1, 0.5
    guide = Guide(torch.rand(4, 6, 3), pull)
    found = make_engine("torch", network, sampler).denoise(noise, cond, mask, "block", guide)
    torch.testing.assert_close(
        found, denoise(network, sampler, noise, cond, mask, guide=guide), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(found[:, :2], guide.actions[:, :2], atol=1e-5, rtol=0)


@torch.no_grad()
def test_a_row_of_a_batch_is_the_row_alone():
    network, sampler = make(), Sampler("ddpm", 10)
    noise, cond, mask = query(sampler)
    engine = make_engine("torch", network, sampler)
    together = engine.denoise(noise, cond, mask)
    for row in range(4):
        rows = slice(row, row + 1)
        alone = engine.denoise(noise[rows], cond[rows], mask[rows])
        torch.testing.assert_close(together[rows], alone, atol=1e-5, rtol=0)
    assert engine.denoise(noise[:0], cond[:0]).shape == (0, 6, 3)


@torch.no_grad()
def test_weights_that_change_are_seen_and_copies_have_tables_of_their_own():
    network, sampler = make(), Sampler("flow", 3)
    noise, cond, _ = query(sampler)
    engine = make_engine("torch", network, sampler)
    before = engine.denoise(noise, cond)
    for other in (copy.deepcopy(engine), pickle.loads(pickle.dumps(engine))):
        assert torch.equal(other.denoise(noise, cond), before)
    network.transformer_blocks[0].modulation.weight.mul_(2)
    found = engine.denoise(noise, cond)
    assert not torch.equal(found, before)
    torch.testing.assert_close(found, denoise(network, sampler, noise, cond), atol=1e-5, rtol=0)


@torch.no_grad()
def test_bac_of_two_blocks_a_layer():
    network, sampler = make(), Sampler("ddpm", 12)
    noise, cond, _ = query(sampler)
    schedule = bac_schedule(calibrate(network, sampler, noise, cond), 4, policy="a policy", top_k=2)
    mask = schedule.mask()
    assert schedule.block_types == ("SA", "FFN")
    assert mask.shape == (12, 6)
    ffn = [set(steps) for steps in schedule.computed_steps[1::2]]
    for name in schedule.settings["upstream_blocks"]:
        layer, kind = int(name.split(".")[1]), name.split(".")[2]
        own = set(schedule.computed_steps[2 * layer + ("SA", "FFN").index(kind)])
        assert own.issuperset(set().union(*ffn[layer:]))
    masks = mask.expand(4, -1, -1)
    found = make_engine("torch", network, sampler).denoise(noise, cond, masks)
    torch.testing.assert_close(found, denoise(network, sampler, noise, cond, masks), atol=1e-5, rtol=0)


def test_operations_are_counted_by_hand():
    network, mask = make(), torch.zeros(4, 6, dtype=torch.bool)
    mask[1:, 1] = True  # the first layer's FFN, three times
    d, tokens, features, observed = 32, 6, 8 + 10, 10
    attention, feed_forward = 4 * d * d * tokens + 2 * tokens**2 * d, 8 * d * d * tokens
    modulation, outside = 3 * d * features, 4 * 8**2 + 2 * 3 * d * tokens
    published = 4 * (3 * (attention + feed_forward + 2 * modulation) + outside) - 3 * (
        feed_forward + modulation
    )
    assert query_flops(network, mask).item() == 2 * published
    engine = make_engine("torch", network, Sampler("flow", 4))
    done = 4 * (3 * (attention + feed_forward) + 2 * 3 * d * tokens) - 3 * feed_forward + 6 * 3 * d * observed
    assert executed_flops(engine, mask).item() == 2 * done
    assert list(engine_block_costs(engine)) == ["SA", "FFN"]


def test_a_mask_of_another_network_is_refused():
    network, sampler = make(), Sampler("flow", 3)
    noise, cond, _ = query(sampler)
    with refused("prune mask"):
        make_engine("torch", network, sampler).denoise(noise, cond, torch.zeros(4, 3, 9, dtype=torch.bool))
