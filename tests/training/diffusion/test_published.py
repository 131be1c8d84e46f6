"""The published shapes against the FLOPs and sizes that are published for them."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.mask import query_flops
from torchrl_sparse.training.diffusion.published import published_network, published_shape


@pytest.mark.parametrize(
    ("task", "giga_flops"),
    [("pusht", 24.7), ("kitchen", 226), ("block_push", 8.64), ("lift", 15.74), ("transport", 15.76)],
)
def test_a_query_costs_what_is_published(task, giga_flops):
    dense = torch.zeros(100, 24, dtype=torch.bool)
    flops = float(query_flops(published_network(task), dense)) / 1e9
    digits = len(str(giga_flops).partition(".")[2])
    assert round(flops, digits) == giga_flops


@pytest.mark.parametrize(("task", "millions"), [("pusht", 9), ("block_push", 9), ("kitchen", 80)])
def test_networks_have_the_published_size(task, millions):
    assert round(sum(p.numel() for p in published_network(task).parameters()) / 1e6) == millions


def test_a_chunk_holds_the_actions_that_are_executed():
    for task in ("pusht", "kitchen", "block_push", "lift"):
        shape = published_shape(task)
        assert shape.n_obs_steps - 1 + shape.n_action_steps <= shape.horizon


def test_sizes_can_differ_and_unknown_tasks_are_named():
    assert published_network("block_push", n_layer=1, n_emb=16).num_blocks == 3
    with refused("task"):
        published_shape("fly")
