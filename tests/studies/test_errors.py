"""Errors of answers that need no episode."""

import pytest
import torch
from tensordict import TensorDict

from recipes.studies.offline_errors.errors import draw_answers, offline_errors
from tests.fixtures.diffusion import SIZES, make_network
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, keys

__all__ = ["make_network"]


def brute_force(answers, demonstrated, dense):
    """The four numbers by loops over pairs."""
    pairs, cross, wanted = [], [], []
    for xs, y, zs in zip(answers, demonstrated, dense, strict=True):
        wanted += [(x - y).norm() for x in xs]
        cross += [(x - z).norm() for x in xs for z in zs]
        pairs += [(xs[i] - xs[j]).norm() for i in range(len(xs)) for j in range(len(xs)) if i != j]
    of_dense = [
        (zs[i] - zs[j]).norm() for zs in dense for i in range(len(zs)) for j in range(len(zs)) if i != j
    ]
    mean = {
        name: torch.stack(values).mean()
        for name, values in (("w", wanted), ("c", cross), ("p", pairs), ("d", of_dense))
    }
    return mean["w"] - mean["p"] / 2, 2 * mean["c"] - mean["p"] - mean["d"]


def test_the_scores_are_those_of_all_pairs():
    answers, dense, demonstrated = torch.randn(3, 4, 5), torch.randn(3, 6, 5), torch.randn(3, 5)
    found = offline_errors(answers, demonstrated, dense)
    score, distance = brute_force(answers, demonstrated, dense)
    assert found.energy_score == pytest.approx(score.item(), abs=1e-5)
    assert found.energy_distance == pytest.approx(distance.item(), abs=1e-5)
    assert found.error == pytest.approx((answers - demonstrated[:, None]).abs().mean().item(), abs=1e-6)
    assert found.spread == pytest.approx(answers.var(1).mean().sqrt().item(), abs=1e-6)


def test_the_mean_of_two_ways_has_the_smaller_error_and_the_worse_score():
    """Demonstrations go left or right; one method goes either way, the other between them."""
    generator = torch.Generator().manual_seed(0)
    sides = torch.randint(2, (200, 9, 1), generator=generator) * 2.0 - 1
    demonstrated, either = sides[:, 0], sides[:, 1:5]
    dense, between = sides[:, 5:], 0.01 * torch.randn(200, 4, 1, generator=generator)
    one, other = (offline_errors(answers, demonstrated, dense) for answers in (either, between))
    assert other.spread < 0.1 < one.spread
    assert one.energy_score < 0.6 < 0.9 < other.energy_score
    assert abs(one.energy_distance) < 0.1 < 0.9 < other.energy_distance
    assert other.error <= one.error + 0.1  # by which nothing is told


def test_one_draw_is_too_few():
    with refused("draws"):
        offline_errors(torch.zeros(1, 1, 1), torch.zeros(1, 1), torch.zeros(1, 2, 1))


def test_draws_are_answers_of_the_policy_to_the_same_queries(make_network):
    states, actions = (SIZES[name] for name in ("cond_dim", "input_dim"))
    scales = (torch.ones(states), torch.zeros(states), torch.ones(actions), torch.zeros(actions))
    policy = DiffusionPolicy(make_network(), Normalizer(*scales), sampler=Sampler("ddpm", 3))
    queries = TensorDict({keys.COND: torch.randn(2, policy.n_obs_steps, states)}, [2])
    drawn = draw_answers(policy, queries, draws=3, n_action_steps=4, seed=5)
    assert drawn.shape == (2, 3, 4 * actions)
    assert drawn.var(1).mean() > 0.1
    assert torch.equal(drawn, draw_answers(policy, queries, draws=3, n_action_steps=4, seed=5))
    second = draw_answers(policy, queries[1:].expand(2), draws=3, n_action_steps=4, seed=5)
    assert torch.allclose(drawn[1], second[1], atol=1e-5)
