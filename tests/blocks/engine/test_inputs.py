"""Inputs of another kind, at every engine: an answer that is the reference's, or an error that names key, expected and got."""

import copy
import pickle

import pytest
import torch
from torch import nn

from tests.blocks.conftest import ACTION_DIM, COND_DIM, HORIZON, NUM_LAYERS, NUM_STEPS, OBS_STEPS, random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.engine import ENGINES, denoise, make_engine
from torchrl_sparse.networks.diffusion.sampler import Sampler


@pytest.fixture(params=ENGINES)
def engine(request, network, ddpm):
    if not ENGINES[request.param].applies(network)[0]:
        pytest.skip(ENGINES[request.param].applies(network)[1])
    return make_engine(request.param, network, ddpm)


def assert_equals_the_reference(engine, network, query, mask=None):
    expected = denoise(network, Sampler("ddpm", NUM_STEPS), *query, mask)
    rounds = engine.name == "native" and "float32" not in engine.detail
    limits = {"atol": 0.02, "rtol": 0} if rounds else {"atol": 2e-5, "rtol": 1e-4}
    torch.testing.assert_close(engine.denoise(*query, mask), expected, **limits)


@pytest.mark.parametrize("masked", [False, True])
def test_an_empty_batch_has_an_empty_answer(engine, query, masked):
    noise, cond = (part[:0] for part in query)
    mask = torch.zeros(0, NUM_STEPS, 3 * NUM_LAYERS, dtype=torch.bool) if masked else None
    actions = engine.denoise(noise, cond, mask)
    assert actions.shape == (0, HORIZON, ACTION_DIM)
    assert actions.dtype == torch.float32
    assert engine.denoise(*query).shape == (5, HORIZON, ACTION_DIM)


NOISE, COND, MASK = (
    torch.zeros(5, NUM_STEPS, HORIZON, ACTION_DIM),
    torch.zeros(5, OBS_STEPS, COND_DIM),
    random_mask(5),
)
EXPECTED = r"expected torch\.float32 on cpu, as the network, got torch"
NO_VALUES = "prune mask: expected a dense tensor with values, got "
OTHER_KINDS = {
    "noise of numpy": ({"noise": NOISE.numpy()}, "noise: expected a dense tensor, got ndarray"),
    "sparse noise": (
        {"noise": NOISE.to_sparse()},
        r"noise: expected a dense tensor, got layout torch\.sparse_coo",
    ),
    "noise without values": ({"noise": NOISE.to("meta")}, rf"noise: {EXPECTED}\.float32 on meta"),
    "noise of integers": ({"noise": NOISE.long()}, rf"noise: {EXPECTED}\.int64 on cpu"),
    "noise in double precision": ({"noise": NOISE.double()}, rf"noise: {EXPECTED}\.float64 on cpu"),
    "a condition that is a list": ({"cond": COND.tolist()}, "cond: expected a dense tensor, got list"),
    "a condition that is a number": ({"cond": COND[0, 0, 0]}, r"cond: expected shape \[1, 2, 5\], got \[\]"),
    "a complex condition": ({"cond": COND.cfloat()}, rf"cond: {EXPECTED}\.complex64 on cpu"),
    "mask without values": ({"mask": MASK.to("meta")}, NO_VALUES + "the meta device"),
    "sparse mask": ({"mask": MASK.to_sparse()}, NO_VALUES + r"layout torch\.sparse_coo"),
    "mask of numpy": (
        {"mask": MASK.numpy()},
        r"prune mask: expected a tensor of dtype torch\.bool, got ndarray",
    ),
    "mask of bytes": ({"mask": MASK.byte()}, r"prune mask: expected a tensor .*, got dtype torch\.uint8"),
}


@pytest.mark.parametrize("case", OTHER_KINDS)
def test_what_is_refused(engine, query, case):
    change, message = OTHER_KINDS[case]
    with refused(message.partition(": ")[0]):
        engine.denoise(**{"noise": query[0], "cond": query[1], "mask": None} | change)


def test_inputs_in_any_order_of_memory(engine, network, query):
    turned = [part.transpose(0, -1).contiguous().transpose(0, -1) for part in (*query, MASK)]
    assert not any(part.is_contiguous() for part in turned)
    assert_equals_the_reference(engine, network, turned[:2], turned[2])
    expanded = query[0][:1].expand(5, -1, -1, -1), query[1][:1].expand(5, -1, -1)
    assert_equals_the_reference(engine, network, expanded, MASK[:1].expand(5, -1, -1))


def lay_out_by_columns(network):
    for parameter in network.parameters():
        if parameter.ndim == 2:
            parameter.data = parameter.data.T.contiguous().T


def test_parameters_that_are_not_contiguous(engine, network, query):
    lay_out_by_columns(network)
    assert not network.head.weight.is_contiguous()
    assert_equals_the_reference(engine, network, query)
    before = engine.denoise(*query)
    for parameter in network.parameters():
        parameter.data.mul_(1.2)  # leaves no record: the first values of each are compared
    assert_equals_the_reference(engine, network, query)
    assert (engine.denoise(*query) - before).abs().max() > 1e-3


def test_a_matrix_that_is_turned_where_it_lies(engine, network, query):
    layer = network.decoder.layers[0].self_attn.out_proj
    before = engine.denoise(*query)
    layer.weight.data = (
        layer.weight.data.T
    )  # as many columns as rows: the same address and the same first value
    assert_equals_the_reference(engine, network, query)
    assert (engine.denoise(*query) - before).abs().max() > 1e-3


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda engine: pickle.loads(pickle.dumps(engine))]
)
def test_a_copy_answers_like_the_original(engine, query, duplicate):
    expected = engine.denoise(*query, MASK)
    assert torch.equal(duplicate(engine).denoise(*query, MASK), expected)


def test_a_deep_copy_keeps_the_weights_that_it_was_made_with(engine, network, query):
    twin, expected = copy.deepcopy(engine), engine.denoise(*query)
    network.head.bias += 1.0
    assert torch.equal(twin.denoise(*query), expected)
    assert not torch.equal(engine.denoise(*query), expected)


@pytest.mark.parametrize("name", ["num_inference_steps", "timesteps", "coefficients", "_chosen"])
def test_a_sampler_cannot_be_shortened_under_an_engine(engine, ddpm, name):
    with pytest.raises(AttributeError, match=f"{name}: expected a sampler to stay as it was made"):
        setattr(ddpm, name, 3)
    with pytest.raises(AttributeError, match=f"{name}: expected a sampler to stay as it was made"):
        delattr(ddpm, name)


def test_weights_that_are_no_floating_point_numbers(engine, network, query):
    engine.denoise(*query)
    network.head.bias.data = network.head.bias.data.int()
    with refused("network"):
        engine.denoise(*query)
    with pytest.raises(ValueError, match=r"'head\.bias' of torch\.int32|it reads float32 weights"):
        make_engine(engine.name, network, Sampler("ddpm", NUM_STEPS))


def replace(module, name, *shape):
    setattr(module, name, nn.Parameter(torch.zeros(*shape), requires_grad=False))


WRONG_SHAPES = {
    "pos_emb": lambda network: replace(network, "pos_emb", 1, 2, 32),
    "head.weight": lambda network: replace(network.head, "weight", 2, 32),
    "cond_obs_emb.weight": lambda network: replace(network.cond_obs_emb, "weight", 32, 2),
    "decoder.layers.1.linear1.weight": lambda network: replace(
        network.decoder.layers[1].linear1, "weight", 8, 32
    ),
    "decoder.layers.0.norm3.bias": lambda network: replace(network.decoder.layers[0].norm3, "bias", 4),
    "encoder.2.bias": lambda network: replace(network.encoder[2], "bias", 3),
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_the_native_engine_reads_no_weight_beyond_its_end(network, ddpm, query, name):
    if not ENGINES["native"].applies(network)[0]:
        pytest.skip(ENGINES["native"].applies(network)[1])
    engine = make_engine("native", network, ddpm)
    WRONG_SHAPES[name](network)
    with refused(f"network: {name}"):
        engine.denoise(*query)


@pytest.mark.parametrize("size", ["horizon", "n_obs_steps", "cond_dim", "input_dim"])
def test_the_native_engine_reads_no_input_beyond_its_end(network, ddpm, query, size):
    if not ENGINES["native"].applies(network)[0]:
        pytest.skip(ENGINES["native"].applies(network)[1])
    engine = make_engine("native", network, ddpm)
    setattr(network, size, 1)
    noise = torch.zeros(5, NUM_STEPS, network.horizon, network.input_dim)
    cond = torch.zeros(5, network.n_obs_steps, network.cond_dim)
    with pytest.raises(ValueError, match=r"(noise|cond): expected \[B, .* as it was packed"):
        engine.denoise(noise, cond)
