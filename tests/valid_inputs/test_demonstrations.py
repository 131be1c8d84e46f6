"""Demonstration files that other people wrote, and what this library makes of them."""

import json
import warnings

import h5py
import numpy as np
import pytest
import torch

from tests.data.published_demos import OSC as OSC_14, env_args_14, env_args_15, record, write
from tests.fixtures.demonstrations import OSC, absolute_env_args, hands
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.absolute import convert_demos
from torchrl_sparse.data.demos import read_initial_state
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.errors import InputError

LIFT = find_robosuite_task("Lift")
HAND = ("robot0_eef_pos", "robot0_eef_quat_site")


@pytest.fixture(scope="module")
def recorded():
    """Two demonstrations of five small deltas."""
    env = RobosuiteEnv("Lift", action_mode="delta")
    demos = [record(env, seed, steps=5) for seed in (1, 2)]
    env.close()
    return demos


def poses(path, env_args=None, steps=6, change=lambda actions: actions):
    """Write a file of absolute poses whose hand is where they command it; ``change`` edits the actions after that."""
    random = np.random.default_rng(0)
    actions = np.zeros((steps, 7))
    actions[:, :3] = random.uniform(-0.2, 0.2, (steps, 3))
    actions[:, 2] += 1
    actions[:, 3:5] = np.pi / np.sqrt(2) + random.uniform(-0.02, 0.02, (steps, 2))
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"], demo["actions"] = steps, change(actions.copy())
        demo["obs/robot0_eef_pos"], demo["obs/robot0_eef_quat_site"] = hands(actions)
        if env_args != "none":
            file["data"].attrs["env_args"] = json.dumps(absolute_env_args() if env_args is None else env_args)
    return path


def converted_actions(path):
    with h5py.File(path) as file:
        return [file[f"data/demo_{index}/actions"][()] for index in range(2)]


def test_deltas_beyond_the_controllers_input_are_clipped_as_robosuite_does_and_counted(recorded, tmp_path):
    """robosuite's `Controller.scale_action` clips; files with 1.79 are reported in ARISE-Initiative/robomimic#116 and #38."""
    strong = [dict(demo, actions=np.array(demo["actions"])) for demo in recorded]
    strong[1]["actions"][2, 5], strong[1]["actions"][3, 6] = 1.79, -1.5
    clipped = [dict(demo, actions=demo["actions"].clip(-1, 1)) for demo in strong]
    for name, demos in (("strong", strong), ("clipped", clipped)):
        write(tmp_path / f"{name}.hdf5", demos, env_args_14(LIFT))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        convert_demos(tmp_path / "clipped.hdf5", tmp_path / "clipped.h5")
    with pytest.warns(
        UserWarning, match=r"strong\.hdf5: 2 numbers of its actions lie beyond the controller's input"
    ):
        convert_demos(tmp_path / "strong.hdf5", tmp_path / "strong.h5")
    for one, other in zip(
        *(converted_actions(tmp_path / f"{name}.h5") for name in ("strong", "clipped")), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    with refused("strong.hdf5"):
        read_demos(tmp_path / "strong.hdf5", HAND)


def changed_15(**changes):
    return env_args_15(LIFT, **changes)


def changed_kwargs(**changes):
    args = env_args_15(LIFT)
    args["env_kwargs"] |= changes
    return args


FLAT_OF_15 = {**env_args_14(LIFT, control_delta=False), "env_version": "1.5.1"}
REFUSED = {
    "another rate": (changed_kwargs(control_freq=10), "demos.hdf5, env_args.env_kwargs.control_freq"),
    "softer": (changed_15(kp=50), "controller_configs.body_parts.right.kp"),
    "interpolated": (changed_15(interpolation="linear"), "body_parts.right.interpolation"),
    "limited": (changed_15(position_limits=[[0] * 3, [1] * 3]), "body_parts.right.position_limits"),
    "coupled": (changed_15(uncouple_pos_ori=False), "body_parts.right.uncouple_pos_ori"),
    "towards the last goal": (changed_15(goal_update_mode="desired"), "body_parts.right.goal_update_mode"),
    "positions alone": (changed_15(type="OSC_POSITION"), "controller_configs.body_parts.right.type"),
    "whole body": (changed_kwargs(controller_configs={"type": "WHOLE_BODY_IK", "body_parts": {}}), "controller_configs.type"),
    "another table": (changed_kwargs(table_full_size=[1, 1, 0.05]), "demos.hdf5, env_args.env_kwargs.table_full_size"),
    "another gripper": (changed_kwargs(gripper_types="WipingGripper"), "demos.hdf5, env_args.env_kwargs.gripper_types"),
    "a range of nothing": (changed_15(output_max=-0.05), "env_kwargs.controller_configs.output_min"),
    "a range of words": (changed_15(input_max="1"), "env_args.env_kwargs.controller_configs.input_max"),
    "what 1.5 does not read": (FLAT_OF_15, "env_kwargs.controller_configs.control_delta"),
    "another simulator": ({"env_name": "Stack", "type": 4}, "demos.hdf5, env_args.type"),
    "another task": ({**changed_15(), "env_name": "Stack_D1"}, "demos.hdf5, env_args.env_name"),
    "a later version": ({**changed_15(), "env_version": "2.0.0"}, "demos.hdf5, env_args.env_version"),
    "no description": ("none", "demos.hdf5"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_changes_the_meaning_of_an_action_or_a_step_is_refused_by_name(tmp_path, name):
    """Sources: the entries that robosuite 1.2 to 1.5 read, and files at 10 actions a second (huggingface/lerobot#3368); each
    gives other motions than this library's environments."""
    env_args, entry = REFUSED[name]
    path = poses(tmp_path / "demos.hdf5", env_args)
    with refused(entry) as refusal:
        convert_demos(path, tmp_path / "out.h5")
    assert str(refusal.value).startswith(str(path))
    with pytest.raises(InputError, match=r"demos\.hdf5"):
        read_demos(path, HAND)
    assert [file.name for file in tmp_path.iterdir()] == ["demos.hdf5"]


def test_states_that_are_another_time_apart_than_the_file_says_are_refused(recorded, tmp_path):
    """MuJoCo's state begins with its time; at 10 actions a second states are 0.1 s apart."""
    slow = [dict(demo, states=np.array(demo["states"])) for demo in recorded]
    for demo in slow:
        demo["states"][:, 0] *= 2
    path = write(tmp_path / "demos.hdf5", slow, env_args_15(LIFT))
    with refused("demos.hdf5, demo_0, states"):
        convert_demos(path, tmp_path / "out.h5")


def test_a_flat_controller_of_robosuite_15_is_in_the_frame_of_the_base(recorded, tmp_path):
    """robosuite 1.5's `refactor_composite_controller_config` completes it by its own default, `input_ref_frame` "base"."""
    flat = {**env_args_15(LIFT), "env_version": "1.5.1"}
    flat["env_kwargs"] = flat["env_kwargs"] | {"controller_configs": OSC_14}
    for name, args in (("flat", flat), ("base", env_args_15(LIFT, frame="base"))):
        convert_demos(write(tmp_path / f"{name}.hdf5", recorded, args), tmp_path / f"{name}.h5")
    for one, other in zip(
        *(converted_actions(tmp_path / f"{name}.h5") for name in ("flat", "base")), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_ranges_of_the_controller_are_honoured(recorded, tmp_path):
    """A device that gives whole numbers up to 100 for the same motion: the same poses."""
    scaled = [dict(demo, actions=np.array(demo["actions"]) * ([100.0] * 6 + [1.0])) for demo in recorded]
    convert_demos(write(tmp_path / "one.hdf5", recorded, env_args_15(LIFT)), tmp_path / "one.h5")
    wide = env_args_15(LIFT, input_max=100, input_min=[-100] * 6)
    convert_demos(write(tmp_path / "wide.hdf5", scaled, wide), tmp_path / "wide.h5")
    for one, other in zip(
        *(converted_actions(tmp_path / f"{name}.h5") for name in ("one", "wide")), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a - [-0.56, 0, 0.912, 0, 0, 0, 0], r"each position within 0\.3 m .*, got one 1\.07 m off at step 0"),
        (lambda a: np.concatenate([a[:, :3] * 1000, a[:, 3:]], axis=1), "each position within 0.3 m"),
        (lambda a: np.concatenate([a[:, :3], np.degrees(a[:, 3:6]) % 60, a[:, 6:]], axis=1), "each rotation within 1.6 rad"),
        (lambda a: np.concatenate([a[:, :3], a[:, 3:6] * 0.1, a[:, 6:]], axis=1), "each rotation within 1.6 rad"),
    ],
    ids=["of the base's frame", "in millimetres", "in degrees", "rotations of deltas"],
)  # fmt: skip
def test_poses_that_the_recorded_hand_could_not_follow_are_refused(tmp_path, change, message):
    """A commanded pose lies ahead of the hand by what a step moves it, and not elsewhere."""
    path = poses(tmp_path / "demos.h5", change=change)
    with refused("demos.h5, demo_0, actions"):
        read_demos(path, HAND)


def test_quaternions_are_read_with_the_environments_sign(tmp_path):
    """robosuite's own observation has w >= 0 (ARISE-Initiative/robosuite#672), which flips while a downward hand moves."""
    shown, flipped = poses(tmp_path / "shown.h5"), poses(tmp_path / "flipped.h5")
    with h5py.File(flipped, "r+") as file:
        quaternion = file["data/demo_0/obs/robot0_eef_quat_site"]
        quaternion[::2] = -quaternion[::2]
    one, other = (read_demos(path, HAND).data[keys.STATE] for path in (shown, flipped))
    assert torch.equal(one, other)
    assert (one[:, 3] + one[:, 4] > 0).all()


def test_a_model_of_robosuite_14_is_named(tmp_path):
    """Its gripper is called gripper0_..., since 1.5 gripper0_right_... (ARISE-Initiative/robomimic#223)."""
    path = poses(tmp_path / "demos.h5")
    with h5py.File(path, "r+") as file:
        demo = file["data/demo_0"]
        demo["states"], demo.attrs["model_file"] = (
            np.zeros((6, 32)),
            '<mujoco><geom name="gripper0_hand_visual"/></mujoco>',
        )
    with refused("demos.h5, demo_0, model_file"):
        read_initial_state(path, 0)


def test_a_file_as_this_library_describes_it_is_read_bit_by_bit(tmp_path):
    """What was right stays: the description of `collect_demos`, also with pictures' and rewards' options."""
    seen = absolute_env_args(
        has_offscreen_renderer=True, camera_heights=84, reward_shaping=True, lite_physics=False
    )
    one, other = poses(tmp_path / "one.h5"), poses(tmp_path / "other.h5", seen)
    assert OSC["input_type"] == "absolute"
    first, second = (read_demos(path, HAND, task="Lift").data for path in (one, other))
    assert (first == second).all()
    with h5py.File(one) as file:
        np.testing.assert_array_equal(
            first[keys.ACTION][:, :3], np.float32(file["data/demo_0/actions"][:, :3])
        )
