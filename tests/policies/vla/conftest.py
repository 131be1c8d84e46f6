"""A vision-language-action policy that runs in milliseconds, and queries for it."""

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("transformers")

from torchrl_sparse.policies.vla.config import VLAConfig
from torchrl_sparse.policies.vla.network import VLANetwork
from torchrl_sparse.policies.vla.normalize import QuantileNormalizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.policies.vla.text import WordTokenizer


@pytest.fixture
def config():
    return VLAConfig.tiny()


@pytest.fixture
def network(config):
    torch.manual_seed(0)
    network = VLANetwork(config).eval()
    with torch.no_grad():  # weights large enough for every token to matter
        for parameter in network.decoder.parameters():
            if parameter.ndim == 2:
                parameter.mul_(5)
    return network


@pytest.fixture
def policy(network):
    ones = torch.ones(8)
    gripper = torch.arange(7) == 6
    normalizer = QuantileNormalizer(-ones, ones, -2 * ones[:7], ones[:7], gripper)
    return VLAPolicy(network, normalizer, WordTokenizer(["lift", "stack", "the", "cube"]))


@pytest.fixture
def query():
    """``query(batch)``: a random query, the same at every call; rows have instructions of different lengths."""

    def make(batch, instructions=("lift the cube", "stack", "lift the red cube")):
        generator = torch.Generator().manual_seed(1)
        images = torch.randint(256, (2, batch, 3, 28, 28), dtype=torch.uint8, generator=generator)
        state = torch.rand(batch, 8, generator=generator)
        texts = [instructions[row % len(instructions)] for row in range(batch)]
        observation = {"image": images[0], "wrist_image": images[1], "state": state}
        return TensorDict({"observation": observation, "language_instruction": texts}, [batch])

    return make
