import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from tests.blocks.conftest import random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.mask import (
    NetworkSizes,
    block_macs,
    block_name,
    fixed_macs,
    mask_from_steps,
    num_buffers,
    prune_rate,
    query_flops,
    steps_from_mask,
    validate_mask,
)
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

LIFT = NetworkSizes(8, horizon=10, n_obs_steps=2, width=256, input_dim=10, output_dim=10, cond_dim=19)


def test_columns_run_over_the_blocks_of_a_layer_first():
    names = [block_name(column) for column in range(6)]
    assert names == [
        "layers.0.SA",
        "layers.0.CA",
        "layers.0.FFN",
        "layers.1.SA",
        "layers.1.CA",
        "layers.1.FFN",
    ]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_valid_mask_of_any_batch_passes(batch):
    validate_mask(random_mask(*batch), num_steps=10, num_layers=2)
    validate_mask(random_mask(*batch), num_steps=10, num_layers=2, batch=batch)


@pytest.mark.parametrize(
    ("mask", "expected", "got"),
    [
        (torch.zeros(10, 6), "torch.bool", "torch.float32"),
        ([[False] * 6] * 10, "torch.bool", "list"),
        (torch.zeros(4, 9, 6, dtype=torch.bool), r"\[4, 10, 6\]", r"\[4, 9, 6\]"),
        (torch.zeros(4, 10, 24, dtype=torch.bool), r"\[4, 10, 6\]", r"\[4, 10, 24\]"),
        (torch.zeros(3, 10, 6, dtype=torch.bool), r"\[4, 10, 6\]", r"\[3, 10, 6\]"),
        (torch.zeros(10, 6, dtype=torch.bool), r"\[4, 10, 6\]", r"\[10, 6\]"),
        (torch.zeros(6, dtype=torch.bool), r"\[4, 10, 6\]", r"\[6\]"),
    ],
)
def test_a_wrong_mask_is_refused_naming_expected_and_got(mask, expected, got):
    with refused("prune mask"):
        validate_mask(mask, num_steps=10, num_layers=2, batch=(4,))


def test_a_first_row_that_prunes_is_refused_naming_the_blocks():
    mask = random_mask(3)
    mask[1, 0, 4] = True
    with refused("prune mask"):
        validate_mask(mask, num_steps=10, num_layers=2)


def test_prune_rate_counts_row_zero():
    mask = torch.ones(2, 10, 6, dtype=torch.bool)
    mask[:, 0] = False
    mask[1] = False
    torch.testing.assert_close(prune_rate(mask), torch.tensor([0.9, 0.0]))


def test_steps_and_mask_are_inverse():
    mask = random_mask()
    assert torch.equal(mask_from_steps(steps_from_mask(mask), 10), mask)


def test_unknown_reuse_is_refused():
    with refused("reuse"):
        num_buffers("layer", 6)


@pytest.mark.parametrize(
    ("sizes", "giga"),
    [
        (LIFT, "15.74"),
        (NetworkSizes(8, 10, 2, 256, 10, 10, 137), "15.75"),  # image tasks
        (NetworkSizes(8, 10, 2, 256, 20, 20, 274), "15.78"),  # Transport, images
        (NetworkSizes(8, 16, 4, 768, 9, 9, 60), "226"),  # Kitchen
        (NetworkSizes(8, 16, 2, 256, 2, 2, 20), "24.7"),  # Push-T
        (NetworkSizes(8, 5, 3, 256, 2, 2, 16), "8.64"),  # Block Push
    ],
)
def test_dense_flops_of_the_published_models(sizes, giga):
    flops = query_flops(sizes, torch.zeros(100, 24, dtype=torch.bool))
    assert f"{flops.item() / 1e9:.{len(giga.partition('.')[2])}f}" == giga


def test_block_shares_and_fixed_part_of_the_published_model():
    macs = block_macs(LIFT)
    assert [round(part / sum(macs), 3) for part in macs] == [0.277, 0.178, 0.544]
    image = NetworkSizes(8, 10, 2, 256, 10, 10, 137)
    assert round(2 * 100 * fixed_macs(image) / 1e9, 2) == 0.34


@pytest.mark.parametrize("n_cond_layers", [0, 2])
def test_flops_equal_those_that_pytorch_counts(n_cond_layers):
    network = TransformerForDiffusion(
        input_dim=4,
        output_dim=3,
        horizon=6,
        n_obs_steps=3,
        cond_dim=5,
        n_layer=2,
        n_emb=32,
        n_cond_layers=n_cond_layers,
    ).train()  # eval mode may take a fused kernel that the counter does not know
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        network(torch.zeros(1, 6, 4), 0, torch.zeros(1, 3, 5))
    assert query_flops(network, torch.zeros(1, 6, dtype=torch.bool)).item() == counter.get_total_flops()


def test_flops_of_a_mask_are_those_of_its_computed_blocks(network):
    masks = random_mask(3, 2)
    masks[0, 0] = False
    flops = query_flops(network, masks)
    assert flops.shape == (3, 2)
    assert flops.dtype == torch.float32
    sizes = NetworkSizes.of(network)
    cost = torch.tensor(block_macs(sizes) * 2)
    for row in [(0, 0), (1, 1), (2, 0)]:
        computed = (~masks[row]).sum(dim=0)
        assert flops[row].item() == 2 * (10 * fixed_macs(sizes) + (computed * cost).sum().item())
    assert flops[0, 0] == flops.max()


def test_flops_refuse_a_mask_of_another_depth(network):
    with refused("prune mask"):
        query_flops(network, torch.zeros(10, 24, dtype=torch.bool))
