"""Policies of the same weights under other units are other policies: what was made for one is refused for the other."""

import json
from dataclasses import replace

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.rollouts.vla_methods import method_identity as vla_identity
from torchrl_sparse.methods.diffusion import method_identity
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

NETWORK = TransformerForDiffusion(
    input_dim=2, output_dim=2, horizon=4, n_obs_steps=2, cond_dim=3, n_layer=1, n_head=1, n_emb=8
)
EPISODE = EpisodeResult(7, True, 30, 4, 6.3e10, 0.0)


def make(scale=1.0, sampler=None):
    state, action = torch.full((3,), scale), torch.ones(2)
    normalizer = Normalizer(state, torch.zeros(3), action, torch.zeros(2))
    return DiffusionPolicy(NETWORK, normalizer, sampler=sampler, engine="reference")


OWN = make()
OTHERS = {"normaliser": make(2.0), "clip range": make(sampler=Sampler(clip_sample_range=2.0))}


def schedule_for(policy_name):
    mask = torch.zeros(100, 3, dtype=torch.bool)
    mask[1::2] = True
    return SchedulePlanner(CacheSchedule.from_mask(mask, method="mine", policy=policy_name))


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_what_was_made_for_a_policy_is_refused_under_other_units(other, tmp_path):
    """A schedule is tuned, and an episode played, on what normaliser and clip range make of the weights."""
    OWN.with_plan(schedule_for(OWN.fingerprint))
    with refused("SchedulePlanner"):
        other.with_plan(schedule_for(OWN.fingerprint))
    EpisodeLog(tmp_path / "a.jsonl", method_identity("dense", OWN)).append(EPISODE)
    with refused("a.jsonl"):
        EpisodeLog(tmp_path / "a.jsonl", method_identity("dense", other))


def test_a_saved_policy_keeps_its_name(tmp_path):
    for policy in (OWN, *OTHERS.values()):
        policy.save_pretrained(tmp_path)
        assert DiffusionPolicy.from_pretrained(tmp_path).fingerprint == policy.fingerprint


def test_files_that_name_the_weights_alone_are_read(tmp_path):
    """Schedules, pruners and episodes of before the normaliser counted."""
    weights = OWN.fingerprint.partition("-")[0]
    OWN.with_plan(schedule_for(weights))
    identity = method_identity("dense", OWN)
    EpisodeLog(tmp_path / "a.jsonl", identity | {"policy": weights}).append(EPISODE)
    assert EpisodeLog(tmp_path / "a.jsonl", identity).episodes[7] == EPISODE
    other = json.dumps(identity).replace(weights, weights[::-1])
    with refused("a.jsonl"):
        EpisodeLog(tmp_path / "a.jsonl", json.loads(other))
    with refused("SchedulePlanner"):
        OWN.with_plan(schedule_for(weights[:8]))


def test_a_vla_of_other_sizes_that_no_tensor_shows_is_another(tmp_path):
    """``published.center_crop`` and ``heads`` change what the same weights answer; nothing in the weights tells them."""
    network = VLANetwork(VLAConfig.tiny())
    policies = [VLAPolicy(network)]
    for changes in ({"crop_area": 0.9}, {"llm": replace(network.config.llm, heads=1)}):
        other = VLANetwork(replace(network.config, **changes))
        other.load_state_dict(network.state_dict())
        policies.append(VLAPolicy(other))
    own, *others = (vla_identity("dense", None, policy, {}) for policy in policies)
    EpisodeLog(tmp_path / "a.jsonl", own | {"policy": own["policy"].partition("-")[0]}).append(EPISODE)
    assert EpisodeLog(tmp_path / "a.jsonl", own).episodes[7] == EPISODE
    EpisodeLog(tmp_path / "b.jsonl", own).append(EPISODE)
    for identity in others:
        with refused("b.jsonl"):
            EpisodeLog(tmp_path / "b.jsonl", identity)
