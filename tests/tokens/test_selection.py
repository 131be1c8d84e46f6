"""Choosing tokens, against loops that do the same one by one."""

import torch

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import VisualSpec
from torchrl_sparse.tokens.selection import (
    best,
    best_per_camera,
    check_budget,
    check_share,
    ranks,
    scaled_layers,
)

SPEC = VisualSpec(32, (keys.IMAGE, keys.WRIST_IMAGE), (4, 4), 56, 128)


def chosen_one_by_one(score, count, among):
    """Ids of the ``count`` highest scores of a row, lower ids first where they are equal."""
    order = sorted((i for i in range(len(score)) if among[i]), key=lambda i: (-score[i], i))
    return set(order[:count])


def test_best_is_the_sorted_prefix():
    generator = torch.Generator().manual_seed(0)
    score = torch.randint(0, 5, (20, 12), generator=generator).float()  # many ties
    among = torch.rand(20, 12, generator=generator) > 0.3
    counts = torch.arange(20)[:, None] % 14
    chosen = best(score, counts, among)
    for row in range(20):
        expected = chosen_one_by_one(score[row].tolist(), int(counts[row]), among[row].tolist())
        assert set(chosen[row].nonzero().flatten().tolist()) == expected


def test_ranks_put_the_dead_last():
    rank = ranks(torch.tensor([[5.0, 1.0, 3.0, 2.0]]), torch.tensor([[False, True, True, True]]))
    assert rank.tolist() == [[3, 2, 0, 1]]


def test_cameras_do_not_compete():
    score = torch.arange(8.0)[None]  # the second camera has all the high ones
    chosen = best_per_camera(score, [torch.tensor([[1]]), torch.tensor([[3]])], torch.ones(1, 8).bool())
    assert chosen.nonzero()[:, 1].tolist() == [3, 5, 6, 7]


def test_layers_keep_their_relative_depth():
    assert scaled_layers([5, 10, 15, 20], 32, 16) == [2, 5, 8, 10]
    assert scaled_layers([5, 10, 15, 20, 25], 32, 4, first=2) == [2, 3]
    assert scaled_layers([31], 32, 4) == []  # beyond the last
    assert scaled_layers([20], 32, 3, first=2) == [2]


def test_budgets_and_shares_that_cannot_be_are_named():
    check_budget("budget", 16, SPEC)
    with refused("budget"):
        check_budget("budget", 17, SPEC)
    with refused("budget"):
        check_budget("budget", 0, SPEC)
    for share in (0.0, 1.1, float("nan")):
        with refused("share"):
            check_share("share", share)
