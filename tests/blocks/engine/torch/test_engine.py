"""The PyTorch engine against the reference: same noise, same mask, same actions."""

import copy
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from torchrl_sparse.blocks.engine import TorchEngine, denoise
from torchrl_sparse.blocks.engine.torch.linear import can_pack, make_linear
from torchrl_sparse.networks.diffusion.coefficients import step_coefficients
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

from .recorded_graph import RecordedGraph

SHAPES = {
    "small": {"horizon": 6, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32},
    "block push": {"horizon": 5, "n_obs_steps": 3, "cond_dim": 16, "n_layer": 2, "n_emb": 64},
    "long, many heads": {"horizon": 16, "n_obs_steps": 4, "cond_dim": 3, "n_layer": 1, "n_emb": 48, "n_head": 8},
    "one observation": {"horizon": 3, "n_obs_steps": 1, "cond_dim": 2, "n_layer": 3, "n_emb": 16, "n_head": 1},
    "not causal": {"horizon": 4, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32, "causal_attn": False},
    "condition layers": {"horizon": 4, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32, "n_cond_layers": 1},
}  # fmt: skip
SCHEDULES = [("ddpm", 12), ("ddpm", 1), ("ddim", 10)]


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


@pytest.mark.parametrize("change", ["in place", "through .data", "state dict", "dtype"])
def test_changed_weights_are_noticed(change):
    network, sampler = make_network("small"), Sampler("ddim", 5)
    engine, query = TorchEngine(network, sampler), make_query(network, sampler, 2)
    before = engine.denoise(*query)
    if change == "in place":
        network.decoder.layers[1].linear1.weight[3, 5] += 1.0
    elif change == "through .data":
        for parameter in network.parameters():
            parameter.data.copy_(1.1 * parameter)
    elif change == "state dict":
        other = copy.deepcopy(network)
        torch.nn.init.normal_(other.head.weight)
        network.load_state_dict(other.state_dict())
    else:
        network.float()
        query = make_query(network, sampler, 2)
    assert largest_error(engine, network, sampler, query) < (1e-4 if change == "dtype" else 1e-9)
    assert change == "dtype" or (engine.denoise(*query) - before).abs().max() > 1e-6


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
    with pytest.raises(ValueError, match=r"noise: expected shape \[2, 5, 6, 4\], got \[2, 4, 6, 4\]"):
        engine.denoise(noise[:, 1:], cond)
    with pytest.raises(ValueError, match="to prune nothing, got True"):
        engine.denoise(noise, cond, torch.ones(2, 5, 6, dtype=torch.bool))
    with pytest.raises(
        ValueError, match=r"reuse: expected one of \['block', 'type', 'single'\], got 'layer'"
    ):
        engine.denoise(noise, cond, reuse="layer")


@pytest.mark.parametrize(
    ("kind", "steps", "timesteps"),
    [
        ("ddpm", 100, None),
        ("ddpm", 16, None),
        ("ddpm", 1, None),
        ("ddim", 100, None),
        ("ddim", 7, None),
        ("ddim", None, [90, 50, 49, 10]),
    ],
)
def test_tabulated_scheduler_equals_the_schedule_to_the_last_bit(kind, steps, timesteps):
    sampler = Sampler(kind, steps, timesteps=timesteps)
    coefficients = step_coefficients(sampler)
    for step in range(sampler.num_inference_steps):
        sample, eps, gaussian = 3 * torch.randn(3, 1, 6, 4)
        gaussian = None if step == sampler.num_inference_steps - 1 else gaussian
        expected = sampler.step(eps, step, sample, gaussian)
        assert torch.equal(coefficients.update(step, sample, eps, gaussian), expected)


@pytest.mark.parametrize("gelu", [False, True])
def test_packed_products_take_any_number_of_rows(gelu):
    weight, bias = torch.randn(24, 16), torch.randn(24)
    packed, general = make_linear(weight, bias, gelu), make_linear(weight.double(), bias.double(), gelu)
    for rows in (1, 10, 160):
        x, out = torch.randn(rows, 16), torch.empty(rows, 24)
        expected = general(x.double(), out.double())
        torch.testing.assert_close(packed(x, out).double(), expected, atol=1e-5, rtol=1e-5)


def captured_engine(network, sampler, graphs):
    """An engine on the CPU that believes to be on a GPU."""
    engine = TorchEngine(network, sampler)
    engine._current()[1].capture = graphs
    return engine


@pytest.mark.parametrize("shape", ["small", "condition layers"])
@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_segments_can_be_captured_once_and_played_for_any_mask(shape, reuse):
    network, sampler, graphs = make_network(shape), Sampler("ddpm", 8), RecordedGraph()
    engine = captured_engine(network, sampler, graphs)
    made = []
    for seed, rate in enumerate([0.5, 0.9, 0.3]):
        query, masks = make_query(network, sampler, 3, seed), make_masks(network, sampler, 3, rate, seed)
        assert largest_error(engine, network, sampler, query, masks, reuse) < 1e-9
        same = masks[:1].repeat(3, 1, 1)
        assert largest_error(engine, network, sampler, query, same, reuse) < 1e-9
        made.append(len(graphs.graphs))
    # Each block for all rows and for some, the end of a step, and the memory if it depends on the step.
    assert made == [2 * network.num_blocks + 1 + (shape == "condition layers")] * 3


def test_a_captured_program_plays_its_computed_blocks_in_order():
    network, sampler, graphs = make_network("small"), Sampler("ddim", 5), RecordedGraph()
    engine, query = captured_engine(network, sampler, graphs), make_query(network, sampler, 1)
    masks = torch.ones(1, 5, network.num_blocks, dtype=torch.bool)
    masks[:, 0], masks[:, 2, 1], masks[:, 3, 4] = False, False, False
    assert largest_error(engine, network, sampler, query, masks) < 1e-9
    finish = network.num_blocks
    assert graphs.replays == [0, 1, 2, 3, 4, 5, finish, finish, 1, finish, 4, finish, finish]


@pytest.mark.parametrize("shape", ["small", "condition layers"])
@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_a_dense_loop_is_one_graph(shape, kind):
    network, sampler, graphs = make_network(shape), Sampler(kind, 4), RecordedGraph()
    engine = captured_engine(network, sampler, graphs)
    for seed in range(3):
        assert largest_error(engine, network, sampler, make_query(network, sampler, 2, seed)) < 1e-9
    assert graphs.replays == [0, 0, 0]


def count_allocations(steps, dtype, rate, shape="small", batch=3):
    """In one query after the first."""
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
