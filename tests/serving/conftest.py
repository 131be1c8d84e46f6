"""A small policy, and a server of it."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch

from tests.fixtures.diffusion import make_network  # noqa: F401
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler
from torchrl_sparse.networks.normalize import Normalizer

collect_ignore_glob = [] if find_spec("websockets") and find_spec("msgpack") else ["test_*.py"]  # extra serve

STEPS = 3
"""Actions of a chunk that are played."""


@pytest.fixture
def policy(make_network):  # noqa: F811
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(10), torch.zeros(10))
    policy = DiffusionPolicy(make_network(), normalizer, engine="native")
    policy.sampler = Sampler("ddpm", 3, spacing="logsnr")
    return policy


@pytest.fixture
def actor(policy):
    return ChunkExecutor(policy, n_action_steps=STEPS)


@pytest.fixture
def server(actor):
    from tests.serving.robots import running

    with running(actor) as made:
        yield made


@pytest.fixture
def episode():
    """States [T, 5] of a robot."""

    def make(seed, steps=8):
        return np.random.default_rng(seed).normal(size=(steps, 5)).cumsum(0) / 5

    return make
