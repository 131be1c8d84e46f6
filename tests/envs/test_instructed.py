"""Environments made for a vision-language-action policy are those it was trained for, or it is refused with a line."""

import importlib.util
import re

import pytest

pytest.importorskip("transformers")

from tests.refusals import refused
from torchrl_sparse.envs import instructed
from torchrl_sparse.envs.instructed import find_instructed_task, instructed_env
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource

CAMERAS = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}


def make_policy(state_dim=9, action_dim=10, **source):
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(state_dim=state_dim, action_dim=action_dim)))
    policy.source = VLASource(**source)
    return policy


@pytest.fixture
def libero(monkeypatch):
    """As if it were installed."""
    monkeypatch.setattr(instructed, "require_libero", lambda: None)


def test_a_policy_sees_what_it_was_trained_with():
    options = instructed_env("lift_named", make_policy(task="LiftNamed", cameras=CAMERAS), CAMERAS).keywords
    assert (options["camera"], options["wrist_camera"]) == ("agentview", "robot0_eye_in_hand")
    assert (options["image_size"], options["object_state"], options["instruction"]) == (28, False, True)
    one = make_policy(task="LiftNamed", cameras={"image": "agentview_image"})
    assert instructed_env("lift_named", one, CAMERAS).keywords["camera"] == "agentview"


@pytest.mark.parametrize(("images", "as_released"), [("openvla_oft", True), ("rendered", False)])
def test_images_of_libero_are_as_the_policy_was_trained(libero, images, as_released):
    policy = make_policy(8, 7, task="libero_goal", images=images)
    options = instructed_env("libero_goal", policy, CAMERAS, horizon=5).keywords
    assert options == {"as_released": as_released, "image_size": 28, "horizon": 5}


@pytest.mark.parametrize(
    ("task", "policy", "message"),
    [
        (
            "lift",
            {"task": "LiftNamed"},
            "policy: expected one that was trained for Lift, got one for LiftNamed",
        ),
        ("libero_10", {"task": "LiftNamed"}, "trained for libero_10, got one for LiftNamed"),
        ("libero_10", {"task": "libero_goal"}, "trained for libero_10, got one for libero_goal"),
        ("lift_named", {"task": "libero_goal"}, "trained for LiftNamed, got one for libero_goal"),
        ("libero_10", {}, "one of 8 observed numbers and 7 of an action, for libero_10, got one of 9 and 10"),
        (
            "transport",
            {"task": "my_own"},
            "one of 18 observed numbers and 20 of an action, for TwoArmTransport",
        ),
        (
            "lift_named",
            {"cameras": {"image": "sideview_image"}},
            "cameras.image: expected sideview_image, which the policy was trained with, got agentview_image",
        ),
    ],
)
def test_a_policy_of_another_task_is_refused(libero, task, policy, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        instructed_env(task, make_policy(**policy), CAMERAS)


def test_unknown_tasks_are_refused_with_those_there_are():
    with refused("task"):
        find_instructed_task("libero_90")


@pytest.mark.skipif(importlib.util.find_spec("libero") is not None, reason="LIBERO is there")
def test_a_suite_without_libero_names_the_extra():
    with pytest.raises(ImportError, match=r"pip install 'torchrl-sparse\[libero\]'"):
        find_instructed_task("libero_spatial")
