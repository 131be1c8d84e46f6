"""The PyTorch engine against the reference: same noise, same mask, same actions."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from tests.refusals import refused
from torchrl_sparse.blocks.engine import TorchEngine, denoise
from torchrl_sparse.blocks.engine.torch.linear import can_pack, make_linear
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

SHAPES = {
    "small": {"horizon": 6, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32},
    "block push": {"horizon": 5, "n_obs_steps": 3, "cond_dim": 16, "n_layer": 2, "n_emb": 64},
    "long, many heads": {"horizon": 16, "n_obs_steps": 4, "cond_dim": 3, "n_layer": 1, "n_emb": 48, "n_head": 8},
    "one observation": {"horizon": 3, "n_obs_steps": 1, "cond_dim": 2, "n_layer": 3, "n_emb": 16, "n_head": 1},
    "not causal": {"horizon": 4, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32, "causal_attn": False},
    "condition layers": {"horizon": 4, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32, "n_cond_layers": 1},
}  # fmt: skip
SCHEDULES = [("ddpm", 12), ("ddpm", 1), ("ddim", 10), ("sde2m", 5), ("unipc", 6)]


def make_network(shape, std=0.2):
    """Float64 and large weights: any difference but rounding is seen, and rounding stays far below 1e-9."""
    torch.manual_seed(0)
    network = TransformerForDiffusion(input_dim=4, output_dim=4, p_drop_attn=0.1, **SHAPES[shape])
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=std)
    return network.eval().requires_grad_(False).double()


def make_query(network, sampler, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(batch, sampler.num_inference_steps, network.horizon, 4, generator=generator)
    cond = torch.randn(batch, network.n_obs_steps, network.cond_dim, generator=generator)
    return noise.to(network.pos_emb), cond.to(network.pos_emb)


def make_masks(network, sampler, batch, rate, seed=0):
    generator = torch.Generator().manual_seed(seed)
    size = (batch, sampler.num_inference_steps, network.num_blocks)
    masks = torch.rand(size, generator=generator) < rate
    masks[:, 0] = False
    return masks


def largest_error(engine, network, sampler, query, masks=None, reuse="block"):
    expected = denoise(network, sampler, *query, masks, reuse=reuse)
    return (engine.denoise(*query, masks, reuse) - expected).abs().max()


@pytest.mark.parametrize(
    "name", ["dpmpp2m5", "ddim_90_50_10_eta0.5", "ddpm10_trailing", "sde2m6_logsnr", "ddim_7"]
)
def test_every_sampler(name):
    network, sampler = make_network("small"), Sampler.from_name(name)
    masks = make_masks(network, sampler, batch=3, rate=0.6)
    query = make_query(network, sampler, batch=3)
    assert largest_error(TorchEngine(network, sampler), network, sampler, query, masks) < 1e-9


@pytest.mark.parametrize(("kind", "steps"), SCHEDULES)
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_reference_for_random_masks(shape, kind, steps):
    network, sampler = make_network(shape), Sampler(kind, steps)
    engine = TorchEngine(network, sampler)
    for seed, (batch, rate) in enumerate([(1, 0.0), (1, 0.5), (1, 0.91), (4, 0.3), (4, 0.8), (3, 1.0)]):
        query = make_query(network, sampler, batch, seed)
        masks = make_masks(network, sampler, batch, rate, seed)
        same = masks[:1].repeat(batch, 1, 1)
        for reuse in ("block", "type", "single"):
            assert largest_error(engine, network, sampler, query, masks, reuse) < 1e-9
            assert largest_error(engine, network, sampler, query, same, reuse) < 1e-9
        assert largest_error(engine, network, sampler, query) < 1e-9


def test_rows_that_compute_nothing_ride_along_with_rows_that_do():
    network, sampler = make_network("small"), Sampler("ddpm", 8)
    masks = torch.zeros(3, 8, 6, dtype=torch.bool)
    masks[0, 1:], masks[1, 1::2], masks[2, 4:6] = True, True, True
    engine, query = TorchEngine(network, sampler), make_query(network, sampler, 3)
    for reuse in ("block", "type", "single"):
        assert largest_error(engine, network, sampler, query, masks, reuse) < 1e-9


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_published_shape_in_float32(reuse):
    """100 steps at the published initialisation: the whole chain within 1e-5 of the reference."""
    torch.manual_seed(0)
    sizes = {"input_dim": 10, "output_dim": 10, "horizon": 10, "n_obs_steps": 2, "cond_dim": 19}
    network, sampler = (
        TransformerForDiffusion(**sizes, n_layer=2).eval().requires_grad_(False),
        Sampler(),
    )
    noise, cond = torch.randn(2, 100, 10, 10), torch.randn(2, 2, 19)
    masks = make_masks(network, sampler, 2, 0.8)
    engine = TorchEngine(network, sampler)
    assert largest_error(engine, network, sampler, (noise, cond), masks, reuse) < 1e-5
    assert torch.equal(engine.denoise(noise, cond, masks, reuse), engine.denoise(noise, cond, masks, reuse))


def test_threads_share_an_engine():
    network, sampler = make_network("small"), Sampler("ddpm", 8)
    engine = TorchEngine(network, sampler)
    queries = [make_query(network, sampler, batch, batch) for batch in (1, 2, 3, 1, 2, 3)]
    alone = [engine.denoise(*query) for query in queries]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda query: engine.denoise(*query), queries))
    assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


def test_another_type_of_weights_is_another_engine_within():
    network, sampler = make_network("small"), Sampler("ddim", 5)
    engine = TorchEngine(network, sampler)
    network.float()
    assert largest_error(engine, network, sampler, make_query(network, sampler, 2)) < 1e-4


@pytest.mark.parametrize("made_within", [False, True])
def test_autocast_changes_nothing(made_within):
    network, sampler = make_network("small").float(), Sampler("ddpm", 5)
    query, masks = make_query(network, sampler, 2), make_masks(network, sampler, 2, 0.5)
    expected = TorchEngine(network, sampler).denoise(*query, masks)
    with torch.autocast("cpu", enabled=made_within):
        engine = TorchEngine(network, sampler)
    with torch.autocast("cpu"):
        assert torch.equal(engine.denoise(*query, masks), expected)
        assert min(engine.block_seconds(2).values()) > 0


def test_results_are_ordinary_tensors_of_their_own():
    network, sampler = make_network("small"), Sampler("ddim", 5)
    engine, query = TorchEngine(network, sampler), make_query(network, sampler, 1)
    first = engine.denoise(*query)
    kept = first.clone()
    engine.denoise(*make_query(network, sampler, 1, seed=1))
    assert torch.equal(first, kept)
    assert not first.is_inference()


def test_wrong_input_is_refused():
    network, sampler = make_network("small"), Sampler("ddim", 5)
    engine, (noise, cond) = TorchEngine(network, sampler), make_query(network, sampler, 2)
    with refused("noise"):
        engine.denoise(noise[:, 1:], cond)
    with refused("prune mask"):
        engine.denoise(noise, cond, torch.ones(2, 5, 6, dtype=torch.bool))
    with refused("reuse"):
        engine.denoise(noise, cond, reuse="layer")


@pytest.mark.parametrize("gelu", [None, "none", "tanh"])
def test_packed_products_take_any_number_of_rows(gelu):
    weight, bias = torch.randn(24, 16), torch.randn(24)
    packed, general = make_linear(weight, bias, gelu), make_linear(weight.double(), bias.double(), gelu)
    for rows in (1, 10, 160):
        x, out = torch.randn(rows, 16), torch.empty(rows, 24)
        expected = general(x.double(), out.double())
        torch.testing.assert_close(packed(x, out).double(), expected, atol=1e-5, rtol=1e-5)


def count_allocations(steps, dtype, rate, shape="small", batch=3):
    """In one policy call after the first."""
    network, sampler = make_network(shape).to(dtype), Sampler("ddpm", steps)
    masks = make_masks(network, Sampler("ddpm", 10), batch, rate).repeat(1, steps // 10, 1)
    engine, query = TorchEngine(network, sampler), make_query(network, sampler, batch)
    engine.denoise(*query, masks)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        engine.denoise(*query, masks)
    events = profiler.profiler.kineto_results.events()
    return sum(event.name() == "[memory]" and event.nbytes() > 0 for event in events)


@pytest.mark.parametrize("shape", ["small", "condition layers"])
@pytest.mark.parametrize("rate", [0.0, 0.5, 0.9])
def test_a_step_allocates_nothing(rate, shape):
    ten, twenty = (count_allocations(steps, torch.float64, rate, shape) for steps in (10, 20))
    assert 0 < ten == twenty


@pytest.mark.skipif(not can_pack(torch.zeros(1)), reason="needs oneDNN")
def test_packed_products_return_memory_of_their_own_and_nothing_else_does():
    """Four in each of two layers, each with its result and what oneDNN works in."""
    ten, twenty = (count_allocations(steps, torch.float32, 0.0) for steps in (10, 20))
    assert twenty - ten <= 10 * 2 * 4 * 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("rate", [0.0, 0.7])
def test_cuda_equals_the_reference(rate):
    network, sampler = make_network("small").cuda(), Sampler("ddpm", 12)
    engine = TorchEngine(network, sampler)
    for seed in (0, 0, 1):  # captured, replayed, replayed for another mask
        query = make_query(network, sampler, 3, seed)
        masks = make_masks(network, sampler, 3, rate, seed).cuda()
        assert largest_error(engine, network, sampler, query, masks) < 1e-9
