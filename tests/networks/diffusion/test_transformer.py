"""The network against torch's own decoder, its causal structure, its size and its parameter names."""

import pytest
import torch
from torch import nn

from tests.refusals import refused
from torchrl_sparse.networks.diffusion.transformer import (
    SinusoidalPosEmb,
    TransformerForDiffusion,
)

LIFT = {"input_dim": 10, "output_dim": 10, "horizon": 10, "n_obs_steps": 2, "cond_dim": 19}


def inputs(network, batch=3):
    generator = torch.Generator().manual_seed(1)
    sample = torch.randn(batch, network.horizon, network.input_dim, generator=generator)
    cond = torch.randn(batch, network.n_obs_steps, network.cond_dim, generator=generator)
    return sample, torch.tensor([99, 40, 0])[:batch], cond


def torch_decoder_forward(network, sample, timestep, cond):
    """The published formulation: one call of `nn.TransformerDecoder` with additive masks built by hand."""
    time_token = network.time_emb(timestep)[:, None]
    tokens = torch.cat([time_token, cond @ network.cond_obs_emb.weight.T + network.cond_obs_emb.bias], dim=1)
    memory = network.encoder(tokens + network.cond_pos_emb)
    masks = {}
    if network.causal_attn:
        steps, seen = range(network.horizon), range(1 + network.n_obs_steps)
        hide = float("-inf")
        masks["tgt_mask"] = torch.tensor([[0.0 if t >= s else hide for s in steps] for t in steps])
        masks["memory_mask"] = torch.tensor([[0.0 if t >= s - 1 else hide for s in seen] for t in steps])
    x = network.decoder(network.input_emb(sample) + network.pos_emb, memory, **masks)
    return network.head(network.ln_f(x))


def test_lift_has_the_published_number_of_parameters():
    assert sum(p.numel() for p in TransformerForDiffusion(**LIFT).parameters()) == 8_967_434
    image = TransformerForDiffusion(**{**LIFT, "cond_dim": 137})
    assert sum(p.numel() for p in image.parameters()) == 8_997_642


def test_state_dict_has_the_published_names_and_shapes():
    shapes = {
        name: tuple(value.shape) for name, value in TransformerForDiffusion(**LIFT).state_dict().items()
    }
    expected = {
        "pos_emb": (1, 10, 256),
        "cond_pos_emb": (1, 3, 256),
        "input_emb.weight": (256, 10),
        "cond_obs_emb.weight": (256, 19),
        "encoder.0.weight": (1024, 256),
        "encoder.2.weight": (256, 1024),
        "decoder.layers.7.self_attn.in_proj_weight": (768, 256),
        "decoder.layers.7.self_attn.out_proj.bias": (256,),
        "decoder.layers.7.multihead_attn.in_proj_bias": (768,),
        "decoder.layers.7.linear1.weight": (1024, 256),
        "decoder.layers.7.norm3.weight": (256,),
        "ln_f.bias": (256,),
        "head.weight": (10, 256),
    }
    assert expected.items() <= shapes.items()
    # Published low-dim policies have 175: these 158, two masks, three dummies and twelve of the normaliser.
    assert len(shapes) == 158


@pytest.mark.parametrize("changes", [{}, {"causal_attn": False}, {"n_cond_layers": 2}, {"n_obs_steps": 4}])
def test_equals_torchs_own_decoder(make_network, changes):
    network = make_network(**changes)
    sample, timestep, cond = inputs(network)
    with torch.no_grad():
        expected = torch_decoder_forward(network, sample, timestep, cond)
        torch.testing.assert_close(network(sample, timestep, cond), expected, atol=1e-5, rtol=1e-5)


def test_blocks_compose_to_the_forward_pass(make_network):
    network = make_network()
    sample, timestep, cond = inputs(network)
    x, memory = network.embed(sample), network.memory(timestep, cond)
    for index in range(network.num_blocks):
        x = x + network.block(index, x, memory)
    assert torch.equal(network.head_out(x), network(sample, timestep, cond))


def test_only_cross_attention_reads_the_memory(make_network):
    network = make_network()
    x = torch.randn(2, network.horizon, network.n_emb)
    memory = torch.randn(2, 3, network.n_emb)
    reads = [not torch.equal(network.block(i, x, memory), network.block(i, x, -memory)) for i in range(6)]
    assert reads == [False, True, False] * 2


def test_an_action_depends_on_no_later_action_and_the_first_on_no_second_observation(make_network):
    network = make_network()
    sample, timestep, cond = inputs(network)
    base = network(sample, timestep, cond)
    later = sample.clone()
    later[:, 3:] += 1
    moved = (network(later, timestep, cond) - base).abs().amax((0, 2))
    assert (moved[:3] == 0).all()
    assert (moved[3:] > 1e-3).all()
    newer = cond.clone()
    newer[:, 1] += 1
    moved = (network(sample, timestep, newer) - base).abs().amax((0, 2))
    assert moved[0] == 0
    assert (moved[1:] > 1e-3).all()


def test_timestep_may_be_a_number_or_a_tensor(make_network):
    network = make_network()
    sample, _, cond = inputs(network)
    expected = network(sample, torch.full((3,), 7), cond)
    assert torch.equal(network(sample, 7, cond), expected)
    assert torch.equal(network(sample, torch.tensor(7), cond), expected)


def test_time_embedding_follows_its_formula():
    embedding = SinusoidalPosEmb(6)(torch.tensor([3]))[0]
    frequency = torch.tensor([1.0, 10000**-0.5, 10000**-1.0])
    torch.testing.assert_close(embedding, torch.cat([(3 * frequency).sin(), (3 * frequency).cos()]))


def test_initialisation_is_the_published_one():
    network = TransformerForDiffusion(**LIFT)
    for module in network.modules():
        if isinstance(module, nn.Linear):
            assert module.weight.std().item() == pytest.approx(0.02, rel=0.1)
            assert (module.bias == 0).all()
        elif isinstance(module, nn.LayerNorm):
            assert (module.weight == 1).all()
            assert (module.bias == 0).all()
    for weight in (network.decoder.layers[3].multihead_attn.in_proj_weight, network.pos_emb):
        assert weight.std().item() == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"n_emb": 10, "n_head": 4}, "n_emb"),
        ({"horizon": 0}, "horizon"),
        ({"n_cond_layers": -1}, "n_cond_layers"),
        ({"n_emb": 2, "n_head": 1}, "dim"),
    ],
)
def test_bad_sizes_are_named(make_network, changes, entry):
    with refused(entry):
        make_network(**changes)


def test_bad_inputs_are_named(make_network):
    network = make_network()
    sample, timestep, cond = inputs(network)
    with refused("sample"):
        network(sample[:, :5], timestep, cond)
    with refused("cond"):
        network(sample, timestep, cond[..., :4])
    with refused("timestep"):
        network(sample, timestep[:2], cond)
