"""Published demonstrations become absolute ones: same goals, same motion, present-day observations, and no half files."""

import json
import warnings

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data.published_demos import env_args_14, env_args_15, record, write
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data import absolute
from torchrl_sparse.data.absolute import AbsoluteActions, convert_demos
from torchrl_sparse.data.demos import read_initial_state
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task

LIFT, TRANSPORT = find_robosuite_task("Lift"), find_robosuite_task("TwoArmTransport")
MASKS = {"train": ["demo_1"], "better": ["demo_0", "demo_1"]}


def recorded(task, seeds, steps=None):
    env = RobosuiteEnv(task.name, action_mode="delta")
    demos = [record(env, seed, steps) for seed in seeds]
    env.close()
    return demos


@pytest.fixture(scope="module")
def lifts():
    return recorded(LIFT, (1, 2))


@pytest.fixture(scope="module")
def published(lifts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    return write(folder / "low_dim_v15.hdf5", lifts, env_args_15(LIFT), masks=MASKS)


@pytest.fixture(scope="module")
def converted(published):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert convert_demos(published, published.with_name("lift.h5")) == 2
    return published.with_name("lift.h5")


def replay(path, task):
    """States [T, S] that the absolute actions of the first demonstration lead to, and whether the last one succeeds."""
    env = RobosuiteEnv(task.name)
    present = env.reset(initial_state=read_initial_state(path, 0))
    states = []
    for action in read_demos(path, task.state_keys).episode(0)[keys.ACTION]:
        states.append(env.sim_env.sim.get_state().flatten())
        present[keys.ACTION] = action
        present = env.step(present)["next"]
    env.close()
    return np.stack(states), bool(present[keys.SUCCESS])


def test_deltas_are_not_read_as_poses(published):
    entry = "low_dim_v15.hdf5"
    with refused(entry):
        read_demos(published, ["robot0_eef_pos"])


def test_absolute_actions_lead_through_the_recorded_states(lifts, converted):
    states, success = replay(converted, LIFT)
    assert success
    np.testing.assert_allclose(states, lifts[0]["states"], atol=1e-4)  # rad, m, and the same a second


def test_two_arms_whose_bases_are_turned(tmp_path):
    demos = recorded(TRANSPORT, (3,), steps=6)
    path = write(tmp_path / "transport.hdf5", demos, env_args_15(TRANSPORT, frame="base"))
    convert_demos(path, tmp_path / "absolute.h5")
    states, _ = replay(tmp_path / "absolute.h5", TRANSPORT)
    np.testing.assert_allclose(states, demos[0]["states"], atol=1e-4)


def test_observations_are_those_of_the_environment_whatever_the_file_says(lifts, converted):
    demos = read_demos(converted, LIFT.state_keys)
    for index, lift in enumerate(lifts):
        seen = np.stack([np.concatenate([step[key] for key in LIFT.state_keys]) for step in lift["seen"]])
        np.testing.assert_allclose(demos.episode(index)[keys.STATE], seen, atol=1e-6)


def test_goals_of_robosuite_14_keep_their_orientation_through_a_rotation_of_zero(lifts, tmp_path):
    lift = dict(lifts[0])
    actions = np.float32(lift["actions"])
    actions[5:8, 3:6] = actions[0, 3:6] = 0
    lift["actions"] = actions
    path = write(tmp_path / "low_dim_v141.hdf5", [lift], env_args_14(LIFT))
    convert_demos(path, tmp_path / "lift.h5")
    with h5py.File(tmp_path / "lift.h5") as file:
        found = file["data/demo_0/actions"][()]
    goal = None
    for step, seen, action in zip(found, lift["seen"], actions.astype(np.float64), strict=True):
        np.testing.assert_allclose(step[:3], seen["robot0_eef_pos"] + 0.05 * action[:3], atol=1e-9)
        if goal is None or action[3:6].any():
            hand = Rotation.from_quat(seen["robot0_eef_quat_site"])
            goal = Rotation.from_rotvec(0.5 * action[3:6]) * hand
        assert (Rotation.from_rotvec(step[3:6]) * goal.inv()).magnitude() < 1e-6
        assert step[6] == action[6]
    assert np.ptp(found[5:8, 3:6], axis=0).max() == 0
    assert np.ptp(found[8:11, 3:6], axis=0).max() > 0


def test_what_else_the_file_holds(published, converted):
    with h5py.File(published) as before, h5py.File(converted) as after:
        assert sorted(after["data/demo_0"]) == ["actions", "dones", "obs", "rewards", "states"]
        assert dict(after["data/demo_1"].attrs) == dict(before["data/demo_1"].attrs)
        assert after["data"].attrs["total"] == before["data"].attrs["total"]
        assert json.loads(after["data"].attrs["env_args"])["env_version"] == "1.5.2"
        for name in ("states", "obs/agentview_image"):
            np.testing.assert_array_equal(after[f"data/demo_1/{name}"], before[f"data/demo_1/{name}"])
        assert after["mask/train"][()].tolist() == [b"demo_1"]
    chosen = read_demos(converted, LIFT.state_keys, filter_key="train", cameras={"image": "agentview_image"})
    everything = read_demos(converted, LIFT.state_keys)
    assert len(chosen) == 1
    assert torch.equal(chosen.data[keys.STATE], everything.episode(1)[keys.STATE])


def test_files_with_poses_keep_them(lifts, converted, tmp_path):
    """Diffusion Policy's own converted files still claim to hold deltas."""
    with h5py.File(converted) as file:
        poses = [file[f"data/demo_{i}/actions"][()] for i in range(2)]
    demos = [lift | {"actions": pose} for lift, pose in zip(lifts, poses, strict=True)]
    path = write(tmp_path / "low_dim_abs.hdf5", demos, env_args_14(LIFT))
    with refused("low_dim_abs.hdf5, demo_0: actions"):
        convert_demos(path, tmp_path / "again.h5")
    convert_demos(path, tmp_path / "again.h5", poses=True)
    with h5py.File(tmp_path / "again.h5") as file:
        np.testing.assert_allclose(file["data/demo_1/actions"], poses[1], atol=1e-6)


def test_a_raw_file_gets_its_observations(published, converted, tmp_path):
    raw = tmp_path / "demo_v15.hdf5"
    raw.write_bytes(published.read_bytes())
    with h5py.File(raw, "r+") as file:
        for demo in file["data"].values():
            del demo["obs"], demo["next_obs"], demo["rewards"], demo["dones"]
    convert_demos(raw, tmp_path / "lift.h5")
    one, other = (read_demos(path, LIFT.state_keys) for path in (tmp_path / "lift.h5", converted))
    assert (one.data == other.data).all()


class Stopped(Exception):
    pass


def test_goes_on_after_a_stop_and_ends_with_the_same_bytes(published, converted, tmp_path, monkeypatch):
    out, done = tmp_path / "lift.h5", []
    convert = AbsoluteActions.convert

    def stop_at_the_second(self, *arrays):
        if len(done) == 1:
            raise Stopped
        done.append(True)
        return convert(self, *arrays)

    monkeypatch.setattr(AbsoluteActions, "convert", stop_at_the_second)
    with pytest.raises(Stopped):
        convert_demos(published, out)
    assert [file.name for file in tmp_path.iterdir()] == ["lift.h5.parts"]
    for leftover in (tmp_path / "lift.h5.parts" / ".demo_1.tmp.h5", tmp_path / ".lift.tmp.h5"):
        leftover.write_bytes(b"cut off")
    monkeypatch.setattr(AbsoluteActions, "convert", lambda *a: done.append(True) or convert(*a))
    assert convert_demos(published, out) == 2
    assert len(done) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["lift.h5"]
    assert out.read_bytes() == converted.read_bytes()


def test_a_finished_file_is_reported_and_never_mixed(published, converted, tmp_path, monkeypatch):
    monkeypatch.setattr(absolute, "AbsoluteActions", None)
    assert convert_demos(published, converted) == 2
    other = tmp_path / "other.hdf5"
    other.write_bytes(published.read_bytes())
    with refused("lift.h5"):
        convert_demos(other, converted)


def set_env_args(value):
    def change(file):
        file["data"].attrs["env_args"] = value if isinstance(value, str) else json.dumps(value)

    return change


def shift_hand(file):
    file["data/demo_1/obs/robot0_eef_pos"][3, 0] += 0.02


def shorten_states(file):
    states = file["data/demo_1/states"][:, :-1]
    del file["data/demo_1/states"]
    file["data/demo_1/states"] = states


def sawyer():
    args = env_args_15(LIFT)
    args["env_kwargs"]["robots"] = "Sawyer"
    return args


@pytest.mark.parametrize(
    ("change", "entry"),
    [
        (
            shift_hand,
            "changed.hdf5, demo_1, obs/robot0_eef_pos",
        ),
        (shorten_states, "changed.hdf5, demo_1"),
        (
            lambda file: file["data"].attrs.pop("env_args"),
            "changed.hdf5",
        ),
        (set_env_args("{"), "changed.hdf5, env_args"),
        (set_env_args(env_args_15(LIFT, type="JOINT_VELOCITY")), "controller_configs.body_parts.right.type"),
        (
            set_env_args(env_args_15(LIFT, frame="base", input_type="absolute")),
            "env_args.env_kwargs.controller_configs",
        ),
        (
            set_env_args(env_args_14(LIFT, impedance_mode="variable")),
            "env_kwargs.controller_configs.impedance_mode",
        ),
        (set_env_args(sawyer()), "changed.hdf5, env_args.env_kwargs.robots"),
    ],
)
def test_what_cannot_be_converted_is_named_and_leaves_no_file(published, tmp_path, change, entry):
    path = tmp_path / "changed.hdf5"
    path.write_bytes(published.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    with refused(entry) as error:
        convert_demos(path, tmp_path / "out.h5")
    assert str(error.value).startswith(str(path))
    assert not (tmp_path / "out.h5").exists()


def test_a_damaged_picture_is_copied_as_it_is_and_named_by_the_reader(published, tmp_path):
    path, out = tmp_path / "changed.hdf5", tmp_path / "out.h5"
    path.write_bytes(published.read_bytes())
    with h5py.File(path, "r") as file:
        chunk = file["data/demo_1/obs/agentview_image"].id.get_chunk_info(0)
    with open(path, "r+b") as raw:
        raw.seek(chunk.byte_offset)
        raw.write(b"\xff" * chunk.size)
    convert_demos(path, out)
    with refused("out.h5, demo_1, obs/agentview_image"):
        read_demos(
            out, LIFT.state_keys, cameras={"image": "agentview_image"}, image_folder=tmp_path / "images"
        )
    assert not list((tmp_path / "images").iterdir())
