"""What engines say that a policy call costs, against a count of the products that they run."""

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from torchrl_sparse.blocks.engine.costs import executed_flops
from torchrl_sparse.blocks.engine.factory import make_engine
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

STEPS, BLOCKS = 5, 6


def make_network(num_cond_layers: int) -> TransformerForDiffusion:
    sizes = {"input_dim": 3, "output_dim": 3, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
    network = TransformerForDiffusion(**sizes, n_layer=2, n_head=4, n_emb=16, n_cond_layers=num_cond_layers)
    return network.double().eval()  # in f64 every product of the PyTorch engine is one that the counter knows


def make_mask(rate: float) -> torch.Tensor:
    mask = torch.rand(1, STEPS, BLOCKS, generator=torch.Generator().manual_seed(0)) < rate
    mask[:, 0] = False
    return mask


def count_products(engine, mask: torch.Tensor) -> int:
    noise, cond = torch.randn(1, STEPS, 6, 3).double(), torch.randn(1, 2, 5).double()
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # one fused call, which is not counted
    try:
        with torch.no_grad(), sdpa_kernel(SDPBackend.MATH):
            engine.denoise(noise, cond, mask)  # the first makes tables
            with FlopCounterMode(display=False) as counter:
                engine.denoise(noise, cond, mask)
    finally:
        torch.backends.mha.set_fastpath_enabled(before)
    return counter.get_total_flops()


@pytest.mark.parametrize("num_cond_layers", [0, 2])
@pytest.mark.parametrize("name", ["torch", "reference"])
@pytest.mark.parametrize("rate", [0.0, 0.6, 1.0])
def test_the_count_is_that_of_the_products_that_run(name, num_cond_layers, rate):
    engine = make_engine(name, make_network(num_cond_layers), Sampler("ddim", STEPS))
    mask = make_mask(rate)
    assert executed_flops(engine, mask).item() == count_products(engine, mask)


def test_a_query_of_fewer_steps_costs_what_the_same_steps_cost_alone():
    engine = make_engine("torch", make_network(0), Sampler("ddim", STEPS))
    mask = make_mask(0.6).repeat(3, 1, 1)
    last = mask[:1, -2:].clone()
    last[:, 0] = False
    counted = executed_flops(engine, mask, torch.tensor([[STEPS], [2], [1]]))
    assert counted[0] == executed_flops(engine, mask[:1]).item()
    assert counted[1] == executed_flops(engine, last).item()
    assert counted[2] == executed_flops(engine, last[:, :1]).item()


def test_rows_are_counted_alone_whatever_the_batch_dimensions():
    engine = make_engine("torch", make_network(0), Sampler("ddim", STEPS))
    masks = torch.stack([make_mask(rate)[0] for rate in (0.0, 0.3, 0.6, 0.9)])
    alone = torch.stack([executed_flops(engine, mask) for mask in masks])
    assert torch.equal(executed_flops(engine, masks.unflatten(0, (2, 2))).flatten(), alone)
