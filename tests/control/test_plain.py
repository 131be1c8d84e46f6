"""A plain loop acts as a rollout in the environment does, and what does not fit is refused by name."""

import numpy as np
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, keys, make_env


@pytest.fixture(scope="module")
def policy():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddpm", 3, spacing="logsnr")
    return policy


def test_it_acts_as_in_the_environment(policy):
    env = make_env("Lift", seeds=[7])
    actor = ChunkExecutor(policy, n_action_steps=3)
    expected = env.rollout(7, actor)
    for _ in range(2):  # the second episode begins again
        actor.reset(seed=7)
        acted = [actor.act({"state": state.double().numpy()}) for state in expected[keys.STATE]]
        assert acted[0].dtype == np.float32
        torch.testing.assert_close(torch.from_numpy(np.stack(acted)), expected["action"])


@pytest.mark.parametrize(
    ("observation", "entry"),
    [
        ({}, "observation"),
        ({"state": np.zeros(19), "force": np.zeros(3)}, "observation"),
        ({"state": np.zeros((1, 19))}, "state"),
        ({"state": np.zeros(18)}, "state"),
        ({"state": np.full(19, np.nan)}, "state"),
        ({"state": np.array(["a"] * 19)}, "state"),
    ],
)
def test_what_does_not_fit_is_refused_by_name_and_not_kept(policy, observation, entry):
    actor = ChunkExecutor(policy)
    actor.reset(seed=1)
    with refused(entry):
        actor.act(observation)
    good = {"state": np.zeros(19)}
    after = actor.act(good)
    actor.reset(seed=1)
    np.testing.assert_array_equal(after, actor.act(good))


def test_a_rollout_without_an_executor_says_that_one_is_missing(policy):
    with refused("action"):
        make_env("Lift", seeds=[7]).rollout(3, policy)


def test_a_policy_describes_what_it_reads(policy):
    lines = policy.describe().splitlines()
    assert lines[0] == "observes the last 2 of"
    assert len([line for line in lines if line.startswith("    [")]) == 19
    assert "returns 9 actions of 10 numbers, the first for the present step" in lines
