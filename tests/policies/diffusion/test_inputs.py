"""Inputs of another kind at the policy: an answer, or an error that names key, expected and got."""

import numpy as np
import pytest
import torch

from tests.policies.diffusion.test_policy import request
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, SAGPruner, Uniform, keys
from torchrl_sparse.blocks.engine import ENGINES
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer


def pruner(policy, rates):
    network = PrunerNetwork(
        policy.sampler.timesteps.tolist(), policy.num_blocks, (2, 5), rate_input=rates is not None
    )
    return SAGPruner(network, PrunerInfo(policy.fingerprint, policy.sampler.name, 0.5, rates))


PLANS = {
    "dense": lambda policy: None,
    "uniform": lambda policy: Uniform(3),
    "pruner": lambda policy: pruner(policy, None),
    "pruner of any rate": lambda policy: pruner(policy, (0.2, 0.8)),
}


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("batch", [(0,), (3, 0), (0, 2)])
@torch.no_grad()
def test_an_empty_batch_has_an_empty_chunk(policy, engine, plan, batch):
    if not ENGINES[engine].applies(policy.network)[0]:
        pytest.skip(ENGINES[engine].applies(policy.network)[1])
    policy.engine, policy.plan = engine, PLANS[plan](policy)
    td = policy(request(*batch))
    assert td[keys.CHUNK].shape == (*batch, 5, 4)
    assert td[keys.FLOPS].shape == td[keys.LATENCY].shape == (*batch, 1)


@torch.no_grad()
def test_an_empty_batch_of_images_has_an_empty_chunk():
    vision = VisionEncoder(["image"], width=16)
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "n_layer": 1, "n_emb": 16}
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    policy = DiffusionPolicy(TransformerForDiffusion(**sizes, cond_dim=69), normalizer, vision=vision)
    td = request(0)
    td[keys.history("image")] = torch.zeros(0, 2, 3, 84, 84, dtype=torch.uint8)
    assert policy(td)[keys.CHUNK].shape == (0, 5, 4)


@pytest.mark.parametrize(
    ("key", "value", "entry"),
    [
        (keys.EPISODE_SEED, torch.full((3, 1), 1.7), "('episode', 'seed')"),
        (keys.EPISODE_STEP, torch.full((3, 1), 0.0), "('episode', 'step')"),
        (keys.EPISODE_SEED, torch.ones(3, 1, dtype=torch.bool), "('episode', 'seed')"),
        (keys.HISTORY_STATE, torch.zeros(3, 2, 5, device="meta"), "('history', 'state')"),
        (keys.HISTORY_STATE, torch.zeros(3, 2, 5, dtype=torch.complex64), "('history', 'state')"),
        (keys.HISTORY_STATE, torch.zeros(3, 2, 5).to_sparse(), "('history', 'state')"),
    ],
)  # fmt: skip
def test_what_is_refused(policy, key, value, entry):
    td = request(3)
    td[key] = value
    with refused(entry):
        policy(td)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.int64])
def test_states_of_another_type_are_answered(policy, dtype):
    td = request(3)
    td[keys.HISTORY_STATE] = td[keys.HISTORY_STATE].round()
    expected = policy(td.clone())[keys.CHUNK]
    td[keys.HISTORY_STATE] = td[keys.HISTORY_STATE].to(dtype)
    torch.testing.assert_close(policy(td)[keys.CHUNK], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.int32, torch.uint8])
def test_seeds_of_fewer_bits_are_the_same_seeds(policy, dtype):
    td = request(3)
    td[keys.EPISODE_SEED] = td[keys.EPISODE_SEED].to(dtype)
    assert torch.equal(policy(td)[keys.CHUNK], policy(request(3))[keys.CHUNK])


@pytest.mark.parametrize("engine", ["torch", "reference"])
def test_a_policy_in_double_precision_answers(policy, engine):
    expected = policy(request(3))[keys.CHUNK]
    policy.engine = engine
    chunk = policy.double()(request(3))[keys.CHUNK]
    torch.testing.assert_close(chunk, expected.double(), atol=1e-5, rtol=0)


class Elsewhere(Planner):
    """Plans where there are no values."""

    def masks(self, cond):
        return torch.zeros(
            len(cond), self.spec.num_inference_steps, self.spec.num_blocks, device="meta"
        ).bool()


def test_a_planner_whose_mask_has_no_values_is_named(policy):
    policy.plan = Elsewhere()
    with refused("Elsewhere.masks: prune mask"):
        policy(request(3))


def test_noise_of_seeds_that_are_fractions_is_refused(policy):
    with refused("seed"):
        policy.sample_noise(torch.tensor([1.7], dtype=torch.float64))


def test_noise_of_numpy_is_refused(policy):
    with refused("noise"):
        policy.denoise(np.zeros((1, 8, 6, 4), np.float32), torch.zeros(1, 2, 5))
