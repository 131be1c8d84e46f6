import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.uniform import Uniform, uniform_mask
from torchrl_sparse.keys import COND, PRUNE_MASK


def test_multiples_of_the_interval_compute_every_block_and_nothing_else_does():
    mask = uniform_mask(10, 6, interval=4)
    assert (~mask).all(dim=1).nonzero().flatten().tolist() == [0, 4, 8]
    assert mask.all(dim=1).sum() == 7


@pytest.mark.parametrize(("interval", "computed"), [(1, 10), (3, 4), (10, 1), (99, 1)])
def test_number_of_computed_steps(interval, computed):
    assert (~uniform_mask(10, 3, interval)).all(dim=1).sum() == computed


@pytest.mark.parametrize(("interval", "computed"), [(7, [0, 7, 9]), (3, [0, 3, 6, 9]), (99, [0, 9])])
def test_the_last_step_may_be_computed_too(interval, computed):
    mask = uniform_mask(10, 3, interval, last=True)
    assert (~mask).all(dim=1).nonzero().flatten().tolist() == computed
    assert (mask != uniform_mask(10, 3, interval)).any() == (interval != 3)


def test_the_planner_writes_the_mask_for_every_observation():
    planner = Uniform(interval=3)
    planner.bind(PlanSpec(num_inference_steps=7, num_layers=2, policy="any"))
    masks = planner(TensorDict({COND: torch.randn(4, 2, 5)}, [4]))[PRUNE_MASK]
    assert torch.equal(masks, uniform_mask(7, 6, 3).expand(4, 7, 6))


@pytest.mark.parametrize("interval", [0, -1, 2.5, "3"])
def test_a_wrong_interval_is_refused(interval):
    with refused("interval"):
        Uniform(interval)
