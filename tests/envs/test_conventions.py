"""Observations of robosuite 1.4 and of 1.5 for one and the same simulator state, each recorded by that version itself."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, keys
from torchrl_sparse.envs.contract import policy_contract
from torchrl_sparse.envs.conventions import translate_objects
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.storage.convention import source_convention

# joint positions and observations after five steps; by robosuite 1.4.1 with mujoco 3.9
RECORDED = json.loads(Path(__file__).with_name("robosuite_1_4_1.json").read_text())
# of the same joint positions of Lift, by robosuite 1.5.2
HAND_TO_CUBE_1_5 = [0.0923528, -0.0549745, -0.1610895]
PUBLISHED = ["object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]


def replayed(task, state_keys, convention):
    env = RobosuiteEnv(task, state_keys=state_keys, convention=convention, seeds=[0])
    env.reset()
    for joint, value in RECORDED[task]["joints"].items():
        for gripper in ("gripper0", "gripper1"):
            joint = joint.replace(f"{gripper}_", f"{gripper}_right_")
        env.sim_env.sim.data.set_joint_qpos(joint, value)
    env.sim_env.sim.forward()
    state = env._observe()[keys.STATE]
    assert env.observation_spec[keys.STATE].shape == state.shape
    own = env.raw_observation(["object"], "1.5")["object"]
    env.close()
    return state.numpy(), own


@pytest.mark.parametrize("task", RECORDED)
def test_the_old_convention_is_what_robosuite_1_4_observed(task):
    old = {"object": RECORDED[task]["observed"]["object-state"]} | RECORDED[task]["observed"]
    expected = np.concatenate([old[key] for key in PUBLISHED])
    state, own = replayed(task, PUBLISHED, "1.4")
    np.testing.assert_allclose(state, expected, atol=1e-6)
    # and both ways between it and what robosuite 1.5 observes
    translated = translate_objects(task, expected[: len(own)], observed="1.4", wanted="1.5")
    np.testing.assert_allclose(translated, own, atol=1e-6)
    back = translate_objects(task, translated, observed="1.5", wanted="1.4")
    np.testing.assert_array_equal(back, expected[: len(own)])


def test_the_present_convention_is_what_robosuite_1_5_observed():
    np.testing.assert_allclose(replayed("Lift", ["object"], "1.5")[0][7:], HAND_TO_CUBE_1_5, atol=1e-6)


def test_state_keys_come_in_the_order_that_is_asked_for():
    forwards, backwards = (replayed("Lift", order, "1.4")[0] for order in (PUBLISHED, PUBLISHED[::-1]))
    fingers, turn, hand, cube = forwards[17:], forwards[13:17], forwards[10:13], forwards[:10]
    np.testing.assert_array_equal(backwards, np.concatenate([fingers, turn, hand, cube]))


@pytest.mark.parametrize(
    ("source", "convention"),
    [
        ({}, "1.5"),
        ({"task": "lift"}, "1.5"),
        ({"weights": "model", "robosuite": None}, "1.4"),
        ({"weights": "model", "robosuite": "1.4.1"}, "1.4"),
        ({"weights": "model", "robosuite": "1.5.0"}, "1.5"),
        ({"weights": "model", "robosuite": "1.10"}, "1.5"),
    ],
)
def test_the_source_of_a_policy_decides(source, convention):
    assert source_convention(source) == convention


def test_an_imported_policy_gets_the_environment_that_it_was_trained_in():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.source = {
        "weights": "ema_model",
        "task": "lift_lowdim",
        "state_keys": PUBLISHED,
        "robosuite": "1.2",
    }
    assert policy_contract("lift", policy).state_keys == tuple(PUBLISHED)
    env = diffusion_env("lift", policy)(seeds=[7])
    state = env.reset()[keys.STATE]
    np.testing.assert_allclose(state[7:10], state[10:13] - state[:3], atol=1e-6)  # the hand minus the cube


@pytest.mark.parametrize(
    ("source", "entry"),
    [
        ({"task": "can_lowdim"}, "policy"),
        ({"task": "tool_hang_lowdim_abs"}, "policy"),
        ({"state_keys": ["object", "robot0_joint_pos"]}, "policy: state_keys"),
        (
            {"state_keys": ["object", "robot0_eef_pos"]},
            "policy",
        ),
        ({"weights": "model", "robosuite": "newest"}, "policy.source['robosuite']"),
    ],
)
def test_a_policy_of_something_else_is_refused_with_both_named(source, entry):
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.source = source
    with refused(entry):
        diffusion_env("lift", policy)


def test_a_task_without_an_old_convention_says_so():
    with refused("convention"):
        RobosuiteEnv("LiftMoving", convention="1.4")
