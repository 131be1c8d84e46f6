"""The native engine against the reference, in double precision: same noise, same mask, same actions."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.engine import denoise
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

AVAILABLE, REASON = native_available()
pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)
SETS = REASON.split(", ") if AVAILABLE else []

SHAPES = {
    "lift": {"horizon": 10, "n_obs_steps": 2, "cond_dim": 19, "n_layer": 2, "n_emb": 64},
    "block push": {"horizon": 5, "n_obs_steps": 3, "cond_dim": 16, "n_layer": 2, "n_emb": 64},
    "kitchen": {"horizon": 16, "n_obs_steps": 4, "cond_dim": 60, "n_layer": 1, "n_emb": 96},
    "no multiple of a vector": {"horizon": 7, "n_obs_steps": 2, "cond_dim": 3, "n_layer": 2, "n_emb": 42, "n_head": 3},
    "more than one part": {"horizon": 3, "n_obs_steps": 1, "cond_dim": 300, "n_layer": 1, "n_emb": 132, "n_head": 2},
    "more rows than registers": {"horizon": 37, "n_obs_steps": 2, "cond_dim": 3, "n_layer": 1, "n_emb": 32},
    "more observations than actions": {"horizon": 2, "n_obs_steps": 9, "cond_dim": 3, "n_layer": 3, "n_emb": 16},
    "one of each": {"horizon": 1, "n_obs_steps": 1, "cond_dim": 1, "n_layer": 1, "n_emb": 8, "n_head": 1},
    "not causal": {"horizon": 6, "n_obs_steps": 3, "cond_dim": 5, "n_layer": 2, "n_emb": 32, "causal_attn": False},
}  # fmt: skip


def make_network(shape="lift", action_dim=7, std=0.08, **changes):
    torch.manual_seed(0)
    sizes = {"input_dim": action_dim, "output_dim": action_dim} | SHAPES[shape] | changes
    network = TransformerForDiffusion(**sizes)
    for name, parameter in network.named_parameters():
        torch.nn.init.normal_(parameter, mean=1.0 if "norm" in name and "weight" in name else 0.0, std=std)
    return network.eval().requires_grad_(False)


def make_query(network, sampler, batch=2, rate=0.7, seed=0):
    generator = torch.Generator().manual_seed(seed)
    steps = sampler.num_inference_steps
    noise = torch.randn(batch, steps, network.horizon, network.input_dim, generator=generator)
    cond = torch.randn(batch, network.n_obs_steps, network.cond_dim, generator=generator)
    mask = torch.rand(batch, steps, network.num_blocks, generator=generator) < rate
    mask[:, 0] = False
    return noise, cond, mask


def exact(network, sampler, noise, cond, mask=None, reuse="block"):
    network.double()
    actions = denoise(network, sampler, noise.double(), cond.double(), mask, reuse=reuse)
    network.float()
    return actions.float()


@cache
def answers_of_the_reference(shape, kind, steps):
    """What every instruction set should answer to a query: with no mask, and with one under every rule of reuse."""
    network, sampler = make_network(shape), Sampler(kind, steps)
    noise, cond, mask = make_query(network, sampler)
    asked = ((None, "block"), (mask, "block"), (mask, "type"), (mask, "single"))
    return [(masks, reuse, exact(network, sampler, noise, cond, masks, reuse)) for masks, reuse in asked]


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize(("kind", "steps"), [("ddpm", 12), ("ddim", 10), ("ddpm", 1), ("unipc", 6)])
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_reference_for_random_masks(shape, kind, steps, instruction_set):
    network, sampler = make_network(shape), Sampler(kind, steps)
    engine = NativeEngine(network, sampler, instruction_set=instruction_set)
    noise, cond, _ = make_query(network, sampler)
    for masks, reuse, expected in answers_of_the_reference(shape, kind, steps):
        assert (engine.denoise(noise, cond, masks, reuse) - expected).abs().max() < 1e-5


@pytest.mark.parametrize("seed", range(12))
def test_property_any_rate_and_rule(seed):
    generator = torch.Generator().manual_seed(seed)
    rate = torch.rand((), generator=generator).item() ** 0.3
    kind, reuse = ("ddpm", "ddim", "sde2m", "unipc")[seed % 4], ("block", "type", "single")[seed % 3]
    shape = list(SHAPES)[torch.randint(len(SHAPES), (), generator=generator)]
    network, sampler = make_network(shape, action_dim=1 + seed), Sampler(kind, 9)
    noise, cond, mask = make_query(network, sampler, batch=3, rate=rate, seed=seed)
    expected = exact(network, sampler, noise, cond, mask, reuse)
    actual = NativeEngine(network, sampler).denoise(noise, cond, mask, reuse)
    assert (actual - expected).abs().max() < 1e-5


@pytest.mark.parametrize(
    "name",
    ["ddim_90_50_49_10", "ddim_7", "ddim_99_0", "ddpm_82_14", "ddpm10_trailing", "ddim_90_50_10_eta0.5",
     "dpmpp2m5", "dpmpp2m2", "sde2m6_logsnr", "unipc_90_50_49_10"],
)  # fmt: skip
def test_every_sampler(name):
    network, sampler = make_network(), Sampler.from_name(name)
    engine = NativeEngine(network, sampler)
    for seed in range(2):  # the second policy call finds what the first one left in memory
        noise, cond, mask = make_query(network, sampler, seed=seed)
        expected = exact(network, sampler, noise, cond, mask)
        assert (engine.denoise(noise, cond, mask) - expected).abs().max() < 1e-5


def test_a_query_without_finite_noise_leaves_nothing_behind():
    network, sampler = make_network(), Sampler("unipc", 5)
    engine, (noise, cond, _) = NativeEngine(network, sampler), make_query(network, sampler, batch=1)
    expected = engine.denoise(noise, cond)
    engine.denoise(torch.full_like(noise, torch.nan), cond)
    assert torch.equal(engine.denoise(noise, cond), expected)


def test_published_sizes_over_the_whole_chain():
    network, sampler = make_network(n_layer=8, n_emb=256, std=0.03), Sampler("ddpm", 100)
    noise, cond, mask = make_query(network, sampler, batch=1, rate=0.91)
    engine = NativeEngine(network, sampler)
    expected = denoise(network, sampler, noise, cond, mask)
    assert (engine.denoise(noise, cond, mask) - expected).abs().max() < 1e-5


def test_all_but_the_first_step_pruned():
    network, sampler = make_network(), Sampler("ddpm", 8)
    noise, cond, mask = make_query(network, sampler, rate=1.1)
    for reuse in ("block", "type", "single"):
        expected = exact(network, sampler, noise, cond, mask, reuse)
        assert (
            NativeEngine(network, sampler).denoise(noise, cond, mask, reuse) - expected
        ).abs().max() < 1e-5


@pytest.mark.parametrize("instruction_set", SETS)
def test_half_precision_weights_are_those_of_a_network_rounded_to_half(instruction_set):
    """Exactly that: what is stored is what is computed with, so only the folded weights differ."""
    network, sampler = make_network(), Sampler("ddim", 5)
    noise, cond, mask = make_query(network, sampler)
    engine = NativeEngine(network, sampler, weights="float16", instruction_set=instruction_set)
    error = (engine.denoise(noise, cond, mask) - exact(network, sampler, noise, cond, mask)).abs().max()
    assert 0 < error < 2e-2
    for parameter in network.parameters():
        parameter.copy_(parameter.half())
    for (
        layer
    ) in network.decoder.layers:  # with neutral norms and a head size of 16, folding keeps f16 numbers
        for norm in (layer.norm1, layer.norm2, layer.norm3):
            norm.weight.fill_(1)
    expected = exact(network, sampler, noise, cond, mask)
    assert (engine.denoise(noise, cond, mask) - expected).abs().max() < 1e-5


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize("shape", ["lift", "kitchen", "more rows than registers", "no multiple of a vector"])
def test_bfloat16_rounds_and_nothing_else(shape, instruction_set):
    """Half an ulp of bfloat16 is 0.2 %; pairs in the wrong order or a lost input would change results by their size."""
    network, sampler = make_network(shape), Sampler("ddpm", 10)
    noise, cond, mask = make_query(network, sampler)
    engine = NativeEngine(network, sampler, weights="bfloat16", instruction_set=instruction_set)
    actions, expected = engine.denoise(noise, cond, mask), exact(network, sampler, noise, cond, mask)
    assert 0 < (actions - expected).abs().max() < 2e-2
    portable = NativeEngine(network, sampler, weights="bfloat16", instruction_set="portable")
    assert (actions - portable.denoise(noise, cond, mask)).abs().max() < 2e-2


@pytest.mark.skipif("amx" not in SETS, reason="no AMX")
@pytest.mark.parametrize("weights", ["float32", "float16", "int8", "bfloat16"])
def test_the_processors_tiles_change_bits_of_bfloat16_alone(weights):
    network, sampler = make_network(), Sampler("ddpm", 10)
    engines = (
        NativeEngine(network, sampler, weights=weights, instruction_set=name)
        for name in ("avx512_bf16", "amx")
    )
    vectors, tiles = (engine.denoise(*make_query(network, sampler)) for engine in engines)
    assert torch.equal(vectors, tiles) == (weights != "bfloat16")


@pytest.mark.parametrize("weights", ["float32", "float16", "bfloat16", "int8"])
def test_a_row_of_a_batch_is_bit_identical_to_the_row_alone_and_threads_change_nothing(weights):
    network, sampler = make_network(), Sampler("ddpm", 10)
    noise, cond, mask = make_query(network, sampler, batch=5)
    together = NativeEngine(network, sampler, weights=weights, threads=1).denoise(noise, cond, mask)
    for threads in (2, 3, 9):
        engine = NativeEngine(network, sampler, weights=weights, threads=threads)
        assert torch.equal(together, engine.denoise(noise, cond, mask))
    engine = NativeEngine(network, sampler, weights=weights)
    for row in range(5):
        one = slice(row, row + 1)
        assert torch.equal(together[one], engine.denoise(noise[one], cond[one], mask[one]))


def test_runs_are_identical_also_when_threads_share_an_engine():
    network, sampler = make_network(), Sampler("ddpm", 30)
    engine, query = NativeEngine(network, sampler), make_query(network, sampler)
    expected = engine.denoise(*query)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: engine.denoise(*query), range(24)))
    assert all(torch.equal(result, expected) for result in results)


def test_an_all_false_mask_is_bit_exactly_dense():
    network, sampler = make_network(), Sampler("ddpm", 10)
    noise, cond, mask = make_query(network, sampler)
    engine = NativeEngine(network, sampler)
    assert torch.equal(engine.denoise(noise, cond), engine.denoise(noise, cond, torch.zeros_like(mask)))


def test_inputs_need_not_be_contiguous_and_are_left_alone():
    network, sampler = make_network(), Sampler("ddpm", 6)
    noise, cond, mask = make_query(network, sampler)
    copies = noise.clone(), cond.clone(), mask.clone()
    engine = NativeEngine(network, sampler)
    expected = engine.denoise(noise, cond, mask)
    turned = [tensor.transpose(1, 2).contiguous().transpose(1, 2) for tensor in (noise, cond, mask)]
    assert torch.equal(engine.denoise(*turned), expected)
    assert all(torch.equal(*pair) for pair in zip((noise, cond, mask), copies, strict=True))


def test_memory_of_a_query_in_inference_mode_serves_everything_after_it():
    network, sampler = make_network("one of each"), Sampler("ddim", 3)
    noise, cond, _ = make_query(network, sampler)
    engine = NativeEngine(network, sampler)
    with torch.inference_mode():
        first = engine.denoise(noise, cond)
    assert torch.equal(engine.denoise(noise, cond), first)
    assert min(engine.block_seconds(2).values()) > 0


def test_block_seconds_names_the_types():
    engine = NativeEngine(make_network(), Sampler("ddim", 5))
    seconds = engine.block_seconds(repeats=2)
    assert list(seconds) == ["SA", "CA", "FFN"]
    assert all(value > 0 for value in seconds.values())


def test_wrong_inputs_are_named():
    network, sampler = make_network(), Sampler("ddpm", 6)
    noise, cond, mask = make_query(network, sampler)
    engine = NativeEngine(network, sampler)
    with refused("noise"):
        engine.denoise(noise[:, :5], cond)
    with refused("cond"):
        engine.denoise(noise, cond.double())
    with refused("prune mask"):
        engine.denoise(noise, cond, mask[..., :3])
    with refused("reuse"):
        engine.denoise(noise, cond, mask, "layer")
    network.train()
    with refused("network"):
        engine.denoise(noise, cond)


def test_what_it_cannot_run_is_refused_with_the_reason():
    sampler = Sampler("ddim", 5)
    assert native_supports(make_network()) == (True, "")
    for network, reason in (
        (make_network(n_cond_layers=1), "native engine"),
        (make_network(output_dim=3), "native engine"),
        (make_network().double(), "native engine"),
        (make_network(n_obs_steps=64), "native engine"),
    ):
        with refused(reason):
            NativeEngine(network, sampler)
    with refused("weights"):
        NativeEngine(make_network(), sampler, weights="int4")
    with refused("instruction_set"):
        NativeEngine(make_network(), sampler, instruction_set="mmx")
    with refused("threads"):
        NativeEngine(make_network(), sampler, threads=0)


def test_weights_outside_the_range_of_half_precision_are_refused():
    network = make_network()
    network.decoder.layers[0].linear1.weight[0, 0] = 1e6
    with refused("weights"):
        NativeEngine(network, Sampler("ddim", 5), weights="float16")
