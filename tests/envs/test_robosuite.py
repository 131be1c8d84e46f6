"""Real robosuite environments, state only."""

import gc
import pickle
import weakref
from functools import partial

import numpy as np
import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv, check_env_specs

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import TASKS, find_robosuite_task
from torchrl_sparse.envs.transforms import EndEffectorVelocity, make_env
from torchrl_sparse.rotations import matrix_to_rot6d

STATE_DIMS = {"Lift": 19, "PickPlaceCan": 23, "NutAssemblySquare": 23, "TwoArmTransport": 59, "ToolHang": 53}


@pytest.mark.parametrize("mode", ["absolute", "delta"])
@pytest.mark.parametrize("task", STATE_DIMS)
def test_specs_hold_and_layout_is_the_published_one(task, mode):
    env = RobosuiteEnv(task, action_mode=mode)
    check_env_specs(env)
    arms = 2 if task.startswith("TwoArm") else 1
    assert env.observation_spec[keys.STATE].shape == (STATE_DIMS[task],)
    assert env.action_spec.shape == ((10 if mode == "absolute" else 7) * arms,)
    assert env.reset()[keys.EEF_VEL].shape == (6 * arms,)
    env.close()


@pytest.fixture(scope="module")
def lift():
    env = RobosuiteEnv("Lift", action_mode="delta")
    yield env
    env.close()


def hold_pose(env):
    """The absolute action that keeps every arm where it is, gripper open."""
    data = env.sim_env.sim.data
    parts = []
    for robot in env.sim_env.robots:
        site = robot.gripper["right"].important_sites["grip_site"]
        parts += [data.get_site_xpos(site), matrix_to_rot6d(data.get_site_xmat(site)), [-1.0]]
    return torch.as_tensor(np.concatenate(parts), dtype=torch.float32)


def run(env, td, action, steps=6):
    states = [td[keys.STATE]]
    for _ in range(steps):
        td = env.step(td.set("action", action))["next"]
        states.append(td[keys.STATE])
    return torch.stack(states)


def test_seed_fixes_the_whole_episode_and_successive_episodes_differ(lift):
    action = torch.tensor([0.3, -0.2, -0.5, 0.0, 0.1, 0.2, 1.0])
    lift.set_seed(5)
    first, second = run(lift, lift.reset(), action), run(lift, lift.reset(), action)
    lift.set_seed(5)
    again = run(lift, lift.reset(), action)
    assert torch.equal(first, again)
    assert not torch.equal(first[0], second[0])


@pytest.mark.parametrize("task", ["Lift", "TwoArmTransport"])
def test_a_hand_whose_numbers_fix_no_rotation_stays_turned_as_it_is(task):
    env = RobosuiteEnv(task, seeds=[7, 7])
    arms, start = env.task.arms, env.reset()
    held = hold_pose(env).view(arms, 10)
    held[:, 2] += 0.02
    saturated = held.clone()
    saturated[0, 3:9] = 1.0  # both rows the same
    lifted = run(env, start, held.view(-1), steps=1)
    found = run(env, env.reset(), saturated.view(-1), steps=1)
    torch.testing.assert_close(found, lifted, rtol=0, atol=1e-5)  # the held rotation is rounded to f32
    env.close()


def test_seeds_are_taken_in_turn_and_reported():
    env = RobosuiteEnv("Lift", seeds=[11, 3])
    resets = [env.reset() for _ in range(3)]
    assert [int(td[keys.EPISODE_SEED]) for td in resets] == [11, 3, 11]
    assert torch.equal(resets[0][keys.STATE], resets[2][keys.STATE])


@pytest.mark.parametrize("task", ["Lift", "PickPlaceCan", "NutAssemblySquare"])
def test_saved_initial_state_restores_the_episode(task):
    env = RobosuiteEnv(task, seeds=[4, 5])
    td = env.reset()
    state, action = env.get_initial_state(), hold_pose(env)
    action[:3] += 0.03
    original = run(env, td, action)
    env.reset()  # something else in between
    restored = run(env, env.reset(initial_state=state), action)
    torch.testing.assert_close(restored, original, atol=1e-6, rtol=0)
    assert int(env.reset(initial_state=state)[keys.EPISODE_SEED]) == 4


def test_horizon_truncates_and_does_not_terminate():
    env = RobosuiteEnv("Lift", action_mode="delta", horizon=3)
    td = env.rollout(10, break_when_any_done=True)["next"]
    assert td.shape == (3,)
    assert td["truncated"].squeeze(-1).tolist() == [False, False, True]
    assert not td["terminated"].any()
    assert td["done"][-1]


def test_success_terminates_and_does_not_truncate():
    env = RobosuiteEnv("Lift", action_mode="delta", horizon=1, seeds=[0])
    td = env.reset()
    sim = env.sim_env.sim
    pose = sim.data.get_joint_qpos(env.sim_env.cube.joints[0]).copy()
    pose[2] += 0.3
    sim.data.set_joint_qpos(env.sim_env.cube.joints[0], pose)
    td = env.step(td.set("action", torch.zeros(7)))["next"]
    assert all(td[key].item() for key in ("success", "terminated", "done"))
    assert not td["truncated"]
    assert td["reward"] == 1.0


def test_absolute_action_reaches_the_commanded_pose():
    env = RobosuiteEnv("Lift", seeds=[1])
    td, target = env.reset(), hold_pose(env)
    target[:3] += 0.05
    assert target.max() > 1
    assert env.action_spec.is_in(
        target
    )  # robosuite's own space has it not (findings/robosuite_absolute_action_space.sh)
    final = run(env, td, target, steps=40)[-1]
    reached = final[env.task.state_slice("robot0_eef_pos")]
    torch.testing.assert_close(reached, target[:3], atol=2e-3, rtol=0)
    torch.testing.assert_close(hold_pose(env)[3:9], target[3:9], atol=5e-3, rtol=0)


def test_velocity_from_poses_agrees_with_the_simulator():
    simulated = RobosuiteEnv("Lift", action_mode="delta", seeds=[2])
    derived = TransformedEnv(
        RobosuiteEnv("Lift", action_mode="delta", seeds=[2]), EndEffectorVelocity(TASKS["Lift"])
    )
    check_env_specs(derived)
    a, b = simulated.reset(), derived.reset()
    assert torch.equal(b[keys.EEF_VEL], torch.zeros(6))
    action = torch.tensor([0.4, 0.2, -0.3, 0.1, 0.0, 0.2, -1.0])
    for _ in range(20):
        a, b = (env.step(td.set("action", action))["next"] for env, td in ((simulated, a), (derived, b)))
    torch.testing.assert_close(b[keys.EEF_VEL], a[keys.EEF_VEL], atol=0.03, rtol=0.1)


def test_history_repeats_the_first_state_then_slides():
    env = make_env("Lift", action_mode="delta", n_obs_steps=3)
    td = env.rollout(4)
    states, history = td[keys.STATE], td[keys.HISTORY_STATE]
    assert torch.equal(history[0], states[0].expand(3, -1))
    assert torch.equal(history[3], states[1:4])
    assert td["is_init"].squeeze(-1).tolist() == [True, False, False, False]


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("batched", [SerialEnv, ParallelEnv])
def test_batched_environments_equal_single_ones(batched):
    env = batched(2, [partial(make_env, "Lift", action_mode="delta", seeds=[seed]) for seed in (8, 9)])
    try:
        together = env.rollout(3, policy=lambda td: td.set("action", torch.full((2, 7), 0.2)))
    finally:
        env.close()
    for row, seed in enumerate((8, 9)):
        alone = make_env("Lift", action_mode="delta", seeds=[seed])
        single = alone.rollout(3, policy=lambda td: td.set("action", torch.full((7,), 0.2)))
        assert torch.equal(together[row]["next"][keys.STATE], single["next"][keys.STATE])


def test_instruction_is_written_when_asked_for():
    env = RobosuiteEnv("Lift", instruction=True)
    check_env_specs(env)
    assert env.reset()[keys.INSTRUCTION] == "lift the red cube"


@pytest.mark.parametrize("far", [1.5, 1e30])
def test_a_delta_beyond_its_bounds_counts_as_the_bound(lift, far):
    direction = torch.tensor([1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 1.0])
    states = []
    for action in (direction, far * direction):
        lift.set_seed(5)
        td = lift.reset()
        states.append(lift.step(td.set("action", action))["next", "observation", "state"])
    assert torch.equal(*states)


@pytest.mark.parametrize("seeds", [[1.7], [torch.tensor(1.7)], ["7"], [None], [-1], [2**63]])
def test_seeds_that_are_no_whole_numbers_are_refused(seeds):
    with refused("seed"):
        RobosuiteEnv("Lift", seeds=seeds)


def test_a_seed_that_is_a_fraction_is_refused_and_changes_nothing(lift):
    lift.set_seed(5)
    with refused("seed"):
        lift._set_seed(1.7)
    assert lift.reset()[keys.EPISODE_SEED] == 5


def test_whole_numbers_of_any_type_are_seeds():
    seeds = [np.int64(3), torch.tensor(4), 5]
    env = RobosuiteEnv("Lift", seeds=seeds)
    assert [env.reset()[keys.EPISODE_SEED].item() for _ in seeds] == [3, 4, 5]


def test_bad_input_is_named(lift):
    with refused("task"):
        find_robosuite_task("Fly")
    assert find_robosuite_task("can") is find_robosuite_task("PickPlaceCan")
    with refused("action_mode"):
        RobosuiteEnv("Lift", action_mode="joint")
    with refused("seeds"):
        RobosuiteEnv("Lift", seeds=[])
    with refused("action"):
        lift._step(lift.reset().set("action", torch.zeros(10)))
    with refused("action"):
        lift._step(lift.reset().set("action", torch.full((7,), float("nan"))))


def test_a_size_of_images_without_a_camera_is_refused():
    with refused("image_size"):
        make_env("LiftNamed", image_size=84)


def test_a_ready_made_environment_is_made_anew_where_it_is_sent():
    """`MultiSyncCollector` sends one that it is given instead of a function."""
    env = make_env("Lift", seeds=[7, 8])
    first = env.reset()
    copy = pickle.loads(pickle.dumps(env))
    assert copy.base_env.sim_env is not env.base_env.sim_env
    assert (copy.reset() == first).all()


@pytest.mark.parametrize(
    ("task", "mode"), [("Lift", "delta"), ("LiftMoving", "absolute"), ("TwoArmTransport", "delta")]
)
def test_what_resets_and_substeps_are_spared_changes_no_bit_of_an_episode(task, mode):
    spared, usual = (RobosuiteEnv(task, action_mode=mode, seeds=[7]) for _ in range(2))
    for name in ("_update_observables", "_load_robots"):
        delattr(usual.sim_env, name)  # back to the class's own, with which every substep does all
    vars(usual.sim_env).pop("_pre_action", None)  # LiftMoving has its class's own all along
    torch.manual_seed(0)
    actions = [spared.action_spec.rand() for _ in range(12)]
    for one, other in zip(*(steps_of(env, actions) for env in (spared, usual)), strict=True):
        assert all(torch.equal(one[key], other[key]) for key in one.keys(True, True))
    compiled = [env.sim_env.robots[0].robot_model.mujoco_model is not None for env in (spared, usual)]
    assert compiled == [False, True]
    spared.close()
    usual.close()


def test_a_reset_leaves_no_simulator_behind():
    """Not even until Python looks for cycles, which it may do after hundreds of episodes."""
    env = RobosuiteEnv("Lift", action_mode="delta", seeds=[7, 8])
    env.reset()
    earlier = weakref.ref(env.sim_env.sim), weakref.ref(env.sim_env.robots[0])
    gc.disable()
    try:
        env.reset()
        assert [find() for find in earlier] == [None, None]
    finally:
        gc.enable()


def steps_of(env, actions):
    """What the environment returns for its reset and for each of the actions."""
    td = env.reset()
    yield td
    for action in actions:
        td = env.step(td.clone().set(keys.ACTION, action))["next"]
        yield td
