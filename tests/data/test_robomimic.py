"""Reading robomimic files: values, order, windows, and files that are refused."""

import h5py
import numpy as np
import pytest
import torch

from tests.fixtures.demonstrations import describe
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.rotations import absolute_to_pose

STATE_KEYS = ("object", "robot0_eef_pos")
LENGTHS = (7, 4, 12)


def write(path, lengths=LENGTHS, order=None):
    """A file whose row r of demonstration i holds the object state (i, r)."""
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in order or range(len(lengths)):
            length = lengths[index]
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = length
            demo["actions"] = actions = random.uniform(-1, 1, (length, 7))
            demo["obs/object"] = np.stack([np.full(length, index), np.arange(length)], axis=1).astype(float)
            demo["obs/robot0_eef_pos"] = actions[:, :3] + random.uniform(-0.1, 0.1, (length, 3))
        describe(file)
    return path


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "demos.h5")


def test_values_of_every_demonstration(path):
    demos = read_demos(path, STATE_KEYS)
    assert len(demos) == 3
    assert demos.starts.tolist() == [0, 7, 11, 23]
    with h5py.File(path) as file:
        for index, length in enumerate(LENGTHS):
            episode, demo = demos.episode(index), file[f"data/demo_{index}"]
            assert episode.batch_size == (length,)
            state = np.concatenate([demo["obs/object"], demo["obs/robot0_eef_pos"]], axis=1)
            np.testing.assert_allclose(episode[keys.STATE], state, rtol=1e-6)
            assert episode[keys.ACTION].shape == (length, 10)
            pose = absolute_to_pose(episode[keys.ACTION].double().numpy())
            np.testing.assert_allclose(pose, demo["actions"], atol=1e-5)
    assert demos.data[keys.STATE].dtype == demos.data[keys.ACTION].dtype == torch.float32


def test_state_follows_the_order_of_its_keys(path):
    one, other = read_demos(path, STATE_KEYS), read_demos(path, STATE_KEYS[::-1])
    assert torch.equal(one.data[keys.STATE].roll(3, -1), other.data[keys.STATE])


def test_demonstrations_come_in_the_order_of_their_numbers(tmp_path):
    path = write(tmp_path / "eleven.h5", lengths=[3] * 11, order=reversed(range(11)))
    demos = read_demos(path, STATE_KEYS)
    assert demos.data[keys.STATE][demos.starts[:-1], 0].tolist() == list(range(11))


def test_windows_repeat_the_edges_and_never_cross_episodes(path):
    demos = read_demos(path, STATE_KEYS)
    rows = demos.window_rows(horizon=6, n_obs_steps=2, n_action_steps=3, episodes=[1])
    # Episode 1 is rows 7..10: windows begin at 7 - 1 and end at 10 + 2 at the latest.
    assert rows.tolist() == [[7, 7, 8, 9, 10, 10], [7, 8, 9, 10, 10, 10]]
    everything = demos.window_rows(6, 2, 3)
    assert len(everything) == sum(length + 1 + 2 - 6 + 1 for length in LENGTHS)
    episode = demos.data[keys.STATE][everything][..., 0]
    assert (episode == episode[:, :1]).all()


def test_every_step_is_the_present_of_exactly_one_window_at_published_sizes(path):
    demos = read_demos(path, STATE_KEYS)
    rows = demos.window_rows(horizon=10, n_obs_steps=2, n_action_steps=9)
    assert sorted(rows[:, 1].tolist()) == list(range(23))


def test_window_pairs_observations_with_the_actions_taken_then(path):
    demos = read_demos(path, STATE_KEYS)
    rows = demos.window_rows(6, 2, 3)
    batch = demos.windows(rows, n_obs_steps=2)
    assert batch[keys.HISTORY_STATE].shape == (len(rows), 2, 5)
    assert batch[keys.ACTION].shape == (len(rows), 6, 10)
    inside = rows[:, 1] == rows[:, 0] + 1
    assert torch.equal(batch[keys.HISTORY_STATE][inside, 1, 1], batch[keys.HISTORY_STATE][inside, 0, 1] + 1)
    assert torch.equal(batch[keys.ACTION][:, 1], demos.data[keys.ACTION][rows[:, 1]])


def test_data_can_be_memory_mapped(path, tmp_path):
    demos = read_demos(path, STATE_KEYS)
    mapped = type(demos)(demos.data.memmap(tmp_path / "map"), demos.starts)
    rows = demos.window_rows(6, 2, 3)
    assert mapped.data.is_memmap()
    assert (mapped.windows(rows, 2) == demos.windows(rows, 2)).all()


@pytest.mark.parametrize("sizes", [(0, 1, 1), (6, 0, 1), (6, 2, 6), (6, 2, 0)])
def test_bad_window_sizes_are_named(path, sizes):
    with refused("horizon"):
        read_demos(path, STATE_KEYS).window_rows(*sizes)


def test_episode_too_short_for_a_window_gives_none(path):
    rows = read_demos(path, STATE_KEYS).window_rows(horizon=12, n_obs_steps=1, n_action_steps=2)
    assert rows[:, 0].unique().tolist() == [11, 12]


def test_horizon_that_fits_nowhere_is_named(path):
    with refused("horizon"):
        read_demos(path, STATE_KEYS).window_rows(30, 2, 3)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.95])
def test_truncated_file_is_named(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with refused("demos.h5"):
        read_demos(path, STATE_KEYS)


def delete(name):
    def change(file):
        del file[name]

    return change


def replace(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def resample(file):
    file["data/demo_1"].attrs["num_samples"] = 5


@pytest.mark.parametrize(
    ("change", "entry"),
    [
        (delete("data"), "demos.h5"),
        (delete("data/demo_1/actions"), "demos.h5, demo_1"),
        (delete("data/demo_2/obs/object"), "demos.h5, demo_2"),
        (
            replace("data/demo_1/actions", np.zeros((4, 6))),
            "demos.h5, demo_1, actions",
        ),
        (
            replace("data/demo_0/obs/object", np.zeros(7)),
            "demos.h5, demo_0, obs/object",
        ),
        (
            replace("data/demo_0/obs/object", np.full((7, 2), np.nan)),
            "demos.h5, demo_0, obs/object",
        ),
        (
            replace("data/demo_1/obs/object", np.zeros((4, 3))),
            "demos.h5",
        ),
        (
            replace("data/demo_1/actions", np.full((4, 7), 1e30)),
            "demos.h5, demo_1, actions: rotation vector",
        ),
        (replace("data/demo_1", np.zeros(3)), "demos.h5, demo_1"),
        (resample, "demos.h5, demo_1, actions"),
    ],
)
def test_malformed_file_names_the_demonstration(path, change, entry):
    with h5py.File(path, "r+") as file:
        change(file)
    with refused(entry) as error:
        read_demos(path, STATE_KEYS)
    assert "demos.h5" in str(error.value)


def test_file_without_demonstrations_and_missing_file(tmp_path):
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        file.create_group("data")
    with refused("empty.h5"):
        read_demos(tmp_path / "empty.h5", STATE_KEYS)
    with refused("nowhere.h5", FileNotFoundError):
        read_demos(tmp_path / "nowhere.h5", STATE_KEYS)


def test_demonstrations_of_another_task_are_refused_with_both_named(path):
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = '{"env_name": "PickPlaceCan", "type": 1, "env_kwargs": {}}'
    with refused("demos.h5"):
        read_demos(path, STATE_KEYS, poses=False, task="Lift")
    assert len(read_demos(path, STATE_KEYS, poses=False, task="PickPlaceCan"))
