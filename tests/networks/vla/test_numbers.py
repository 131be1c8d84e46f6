"""FLOPs against PyTorch's own counter, normalisation, the crop, and the presets."""

import dataclasses

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from tests.refusals import refused
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.flops import decoder_flops, fixed_flops, query_flops
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.vision import center_crop


@torch.no_grad()
def test_flops_are_those_that_pytorch_counts(policy, query):
    # PyTorch cannot count its fused CPU kernel
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        td = policy(query(1, ["lift the cube"]))
    assert td["cost", "flops"].item() == counter.get_total_flops()


def test_the_published_decoder_takes_eight_teraflop():
    dense = decoder_flops(VLAConfig(), torch.full((32,), 605)).item()
    assert dense == pytest.approx(8.03e12, rel=1e-3)
    half = decoder_flops(VLAConfig(), torch.full((32,), 285)).item()
    assert half / dense == pytest.approx(0.465, abs=5e-4)


def test_padding_and_batch_do_not_count():
    config, none = VLAConfig.tiny(), torch.zeros(2, dtype=torch.int64)
    tokens = torch.tensor([[40, 40, 40, 40], [40, 30, 30, 0]])
    both = query_flops(config, tokens, none)
    assert torch.equal(both[1:], query_flops(config, tokens[1:], none[1:]))
    fixed = sum(fixed_flops(config).values())
    assert both[0].item() == fixed + 4 * (2 * 40 * (4 * 32**2 + 3 * 32 * 64) + 4 * 32 * 40**2)


def test_normalisation_maps_back():
    torch.manual_seed(0)
    state, action = torch.randn(1000, 8), 0.3 * torch.randn(1000, 7) + 0.1
    action[:, 6] = action[:, 6].sign()
    normalizer = QuantileNormalizer.fit(state, action)
    unit = normalizer.normalize_action(action)
    inside = unit.abs() < 1
    assert 0.97 < inside[:, :6].float().mean() < 0.99
    assert set(unit[:, 6].unique().tolist()) == {0.0, 1.0}
    back = normalizer.unnormalize_action(unit)
    torch.testing.assert_close(back[:, 6], action[:, 6])
    torch.testing.assert_close(back[inside], action[inside])
    assert normalizer.normalize_state(100 * state).abs().max() == 1


def test_grippers_are_decided_at_a_half():
    ones = torch.ones(1)
    normalizer = QuantileNormalizer(-ones, ones, -ones, ones, torch.tensor([True]))
    assert normalizer.unnormalize_action(torch.tensor([[0.49], [0.51]])).tolist() == [[1.0], [-1.0]]


def test_impossible_quantiles_are_refused():
    one = torch.ones(1)
    with refused("action"):
        QuantileNormalizer(-one, one, one, -one, one.bool())
    with refused("gripper"):
        QuantileNormalizer(-one, one, -one, one, one)


def test_the_crop_is_central_and_linear():
    ramp = torch.arange(0, 224, dtype=torch.uint8).expand(1, 3, 224, 224)
    cropped = center_crop(ramp, 0.9)[0, 0].float()
    side = 0.9**0.5
    expected = torch.linspace(0.5 - side / 2, 0.5 + side / 2, 224) * 223
    assert (cropped - expected).abs().max() <= 1
    assert torch.equal(cropped[0], cropped[-1])


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"image_size": 30}, "image_size"),
        ({"cameras": ()}, "cameras"),
        ({"crop_area": 0.0}, "crop_area"),
        ({"chunk_size": 0}, "chunk_size"),
        ({"dino": TransformerSize(16, 1, 2, 32)}, "dino, siglip"),
        ({"dino": TransformerSize(16, 2, 2, 40)}, "dino.mlp"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(changes, entry):
    with refused(entry):
        VLAConfig.tiny(**changes)


def test_the_published_sizes():
    config = VLAConfig()
    assert (config.num_visual, config.num_slots, config.grid) == (512, 56, (16, 16))
    assert dataclasses.asdict(config.llm) == {"dim": 4096, "layers": 32, "heads": 32, "mlp": 11008}
