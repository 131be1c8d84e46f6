"""What a policy says of how it is to be fed: the rate of its actions, and which robosuite's objects it means."""

import json

import pytest
import torch

from tests.refusals import refused
from tests.storage.published.checkpoints import LowDimPolicy
from tests.valid_inputs.checkpoints import read
from torchrl_sparse import DiffusionPolicy, Normalizer, TransformerForDiffusion
from torchrl_sparse.envs.contract import policy_contract
from torchrl_sparse.envs.for_policy import diffusion_env


def make(source, action_dim=10, state_dim=19):
    sizes = {"input_dim": action_dim, "output_dim": action_dim, "cond_dim": state_dim}
    network = TransformerForDiffusion(**sizes, horizon=4, n_obs_steps=2, n_layer=1, n_head=1, n_emb=8)
    ones, zeros = torch.ones, torch.zeros
    units = Normalizer(ones(state_dim), zeros(state_dim), ones(action_dim), zeros(action_dim))
    policy = DiffusionPolicy(network, units, engine="reference")
    policy.source = source
    return policy


@pytest.mark.parametrize("beside", [True, False])
def test_the_rate_of_a_checkpoint_is_read_where_robomimic_notes_it(tmp_path, beside):
    """robomimic's env_meta says at how many actions a second the demonstrations were recorded."""

    def note(payload):
        meta = {"env_name": "Lift", "env_version": "1.4.1", "env_kwargs": {"control_freq": 10}}
        if beside:
            payload["env_meta"] = meta
        else:
            payload["cfg"].task.env_meta = meta

    policy = read(tmp_path, LowDimPolicy(), note)
    assert (policy.source["robosuite"], policy.source["control_freq"]) == ("1.4.1", 10)
    policy.save_pretrained(tmp_path / "saved")
    assert DiffusionPolicy.from_pretrained(tmp_path / "saved").source == policy.source


def test_a_policy_of_another_rate_is_refused():
    """Its chunk would be played at twice its speed: what it was shown for 0.8 s passes in 0.4."""
    for show in (policy_contract, diffusion_env):
        with refused("policy"):
            show("lift", make({"control_freq": 10}))
        show("lift", make({"control_freq": 20}))
        show("lift", make({"control_freq": 20.0}))
        show("lift", make({}))


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({}, "1.5"),
        ({"weights": "ema_model"}, "1.4"),
        ({"weights": "ema_model", "robosuite": "1.5.1", "state_keys": ["object"]}, "1.5"),
        ({"weights": "model", "robosuite": "1.4.1", "state_keys": ["object"]}, "1.4"),
    ],
)
def test_a_policy_says_which_objects_it_means(source, said, tmp_path):
    """The same names stand for other numbers in robosuite 1.4 and 1.5, and nobody translates what a robot's loop hands in."""
    policy = make(source)
    assert f"as robosuite {said} observes them" in policy.describe()
    policy.export(tmp_path / "policy.tsp")
    content = (tmp_path / "policy.tsp").read_bytes()
    start = content.index(b'{"format": "tsp/1"')
    described, _ = json.JSONDecoder().raw_decode(content[start:].decode("utf-8", "replace"))
    assert described["robosuite"] == said


def test_a_state_without_objects_has_one_meaning():
    assert "robosuite 1." not in make({"state_keys": ["robot0_eef_pos"]}, state_dim=3).describe()
