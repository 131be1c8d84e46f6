"""Environments made for a policy show what it observes, or say what they lack."""

import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, TransformerForDiffusion, VisionEncoder, keys
from torchrl_sparse.envs.for_policy import diffusion_env


def seeing_policy(cameras):
    vision = VisionEncoder([*cameras], image_size=(40, 40), crop_size=[36, 36], width=16)
    state = 9
    network = TransformerForDiffusion(
        input_dim=10, output_dim=10, horizon=10, n_obs_steps=3, cond_dim=vision.feature_dim + state, n_layer=1, n_emb=16
    )  # fmt: skip
    normalizer = Normalizer(torch.ones(state), torch.zeros(state), torch.ones(10), torch.zeros(10))
    return DiffusionPolicy(network, normalizer, vision=vision, engine="reference")


def test_the_history_is_as_long_as_the_policy_wants():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    env = diffusion_env("lift", policy, horizon=5)(seeds=[7])
    assert env.reset()[keys.HISTORY_STATE].shape == (policy.n_obs_steps, 19)
    assert env.base_env.horizon == 5


def test_cameras_come_from_where_the_policy_was_trained():
    policy = seeing_policy(["image", "wrist_image"])
    policy.source = {"cameras": {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}}
    options = diffusion_env("lift", policy).keywords
    assert options["camera"] == "agentview"
    assert options["wrist_camera"] == "robot0_eye_in_hand"
    assert (options["image_size"], options["object_state"], options["n_obs_steps"]) == (40, False, 3)


def test_a_policy_that_does_not_name_its_cameras_is_refused():
    policy = seeing_policy(["image"])
    with refused("policy.source['cameras']"):
        diffusion_env("lift", policy)
