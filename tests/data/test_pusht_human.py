"""The published demonstrations of Push-T in robomimic's layout: observed as the environment observes, or refused by name."""

import h5py
import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.pusht_human import convert_pusht
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.pusht import block_keypoints

ENDS = [3, 7]


def recording(**changes):
    """Two episodes of 3 and 4 steps as the npz holds them."""
    rng = np.random.default_rng(0)
    state = rng.uniform([0, 0, 100, 100, -np.pi], [512, 512, 400, 400, np.pi], (7, 5)).astype(np.float32)
    arrays = {
        "state": state,
        "keypoint": np.stack([block_keypoints(row[2:4], row[4]) for row in state]).astype(np.float32),
        "action": rng.uniform(0, 512, (7, 2)).astype(np.float32),
        "episode_ends": np.array(ENDS),
    }
    return {name: value for name, value in (arrays | changes).items() if value is not None}


@pytest.fixture
def source(tmp_path):
    return tmp_path / "human.npz"


def test_what_is_recorded_is_read(source, tmp_path):
    arrays = recording()
    np.savez(source, **arrays)
    assert convert_pusht(source, tmp_path / "human.h5") == 2
    demos = read_demos(tmp_path / "human.h5", ("state",), poses=False)
    assert demos.starts.tolist() == [0, *ENDS]
    np.testing.assert_array_equal(demos.data[keys.ACTION], arrays["action"])
    observed = np.concatenate([arrays["keypoint"].reshape(7, 18), arrays["state"][:, :2]], axis=1)
    np.testing.assert_allclose(demos.data[keys.STATE], observed, atol=1e-4)
    with h5py.File(tmp_path / "human.h5") as file:
        np.testing.assert_array_equal(file["data/demo_1/states"], arrays["state"][3:])


def test_observations_are_those_of_the_environment_where_recorded_keypoints_are_not(source, tmp_path):
    arrays = recording()
    np.savez(source, **arrays | {"keypoint": arrays["keypoint"] + 2})
    convert_pusht(source, tmp_path / "human.h5")
    demos = read_demos(tmp_path / "human.h5", ("state",), poses=False)
    np.testing.assert_allclose(
        demos.data[keys.STATE][:, :18], arrays["keypoint"].reshape(7, 18), atol=1e-4, rtol=0
    )


def test_the_simulator_observes_the_same(source, tmp_path):
    pytest.importorskip("gym_pusht", reason="needs the extra pusht")
    from torchrl_sparse.envs.pusht import PushTEnv

    arrays = recording()
    np.savez(source, **arrays)
    convert_pusht(source, tmp_path / "human.h5")
    read = read_demos(tmp_path / "human.h5", ("state",), poses=False).data[keys.STATE][0]
    env = PushTEnv(seeds=[0])
    env.reset()
    agent, block = env.sim_env.agent, env.sim_env.block
    block.angle = float(arrays["state"][0, 4])
    agent.position, block.position = (tuple(map(float, arrays["state"][0, i : i + 2])) for i in (0, 2))
    np.testing.assert_allclose(env._observe_state(), read, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"action": None}, "human.npz"),
        ({"action": np.zeros((7, 3))}, "human.npz, action"),
        ({"state": np.zeros((6, 5))}, "human.npz, state"),
        ({"episode_ends": np.array([3, 3])}, "human.npz, episode_ends"),
        ({"episode_ends": np.array([], int)}, "human.npz, episode_ends"),
        ({"action": np.full((7, 2), np.nan)}, "human.npz, action"),
        ({"action": np.full((7, 2), "left")}, "human.npz, action"),
        ({"action": np.ones((7, 2), complex)}, "human.npz, action"),
        ({"episode_ends": np.array([3.0, 7.0])}, "human.npz, episode_ends"),
        ({"keypoint": np.zeros((7, 9, 2))}, "human.npz, keypoint"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_by_name(source, tmp_path, changes, entry):
    np.savez(source, **recording(**changes))
    with refused(entry):
        convert_pusht(source, tmp_path / "human.h5")
    assert not (tmp_path / "human.h5").exists()


def flip(content, place):
    return content[:place] + bytes([content[place] ^ 255]) + content[place + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda _: b"hello",
        lambda content: content[:-30],
        lambda content: content[100:],
        lambda content: flip(content, 200),  # within an array: its checksum fails, or its compression
        lambda content: flip(content, content.index(b"PK\x01\x02") + 10),  # how an array is compressed
    ],
)
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_damaged_files_are_refused(source, tmp_path, damage, save):
    save(source, **recording())
    source.write_bytes(damage(source.read_bytes()))
    with refused("human.npz") as error:
        convert_pusht(source, tmp_path / "human.h5")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "human.h5").exists()


def test_a_missing_file_is_named(tmp_path):
    with refused("none.npz", FileNotFoundError):
        convert_pusht(tmp_path / "none.npz", tmp_path / "human.h5")
