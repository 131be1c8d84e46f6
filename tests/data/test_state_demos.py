"""Demonstrations of benchmarks outside robosuite: collected, read and normalised."""

import h5py
import numpy as np
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.demos import Collection, collect
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.block_push_scene import published_start
from torchrl_sparse.networks.normalize import Normalizer

pytest.importorskip("pybullet", reason="needs the extra blockpush")
TWO = Collection("block_push", episodes=2, seed=20)


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "block_push.h5"
    return path, collect(path, TWO)


def test_actions_are_read_as_they_are(collected):
    path, summary = collected
    demos = read_demos(path, ("state",), poses=False)
    assert (len(demos), summary.successes, summary.attempts) == (2, 2, 2)
    assert len(demos.data) == summary.mean_length * 2
    with h5py.File(path) as file:
        demo = file["data/demo_1"]
        rows = demos.episode(1)
        np.testing.assert_allclose(rows[keys.ACTION], demo["actions"], atol=1e-7)
        np.testing.assert_allclose(rows[keys.STATE], demo["obs/state"], atol=1e-6)
        seed, noise = int(demo.attrs["seed"]), demo["executed_actions"][:] - demo["actions"][:]
    start = published_start(seed)
    np.testing.assert_allclose(rows[keys.STATE][0][[0, 1, 3, 4]], start.blocks[:, :2].ravel(), atol=1e-3)
    assert 0.002 < noise.std() < 0.006
    moved = rows[keys.STATE][1:, 8:10] - rows[keys.STATE][:-1, 8:10]
    np.testing.assert_allclose(moved, demos_executed(path)[:-1], atol=1e-5)


def demos_executed(path):
    with h5py.File(path) as file:
        return file["data/demo_1/executed_actions"][:]


def test_without_that_they_are_refused_as_poses(collected):
    with refused("block_push.h5, env_args.type"):
        read_demos(collected[0], ("state",))


def test_the_same_command_makes_the_same_file(collected, tmp_path):
    path, summary = collected
    assert collect(tmp_path / "again.h5", TWO) == summary
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


def test_every_dimension_of_actions_is_normalised_to_its_range(collected):
    data = read_demos(collected[0], ("state",), poses=False).data
    normalizer = Normalizer.fit(data[keys.STATE], data[keys.ACTION], state_mode="range", poses=False)
    for normal in (
        normalizer.normalize_action(data[keys.ACTION]),
        normalizer.normalize_state(data[keys.STATE]),
    ):
        torch.testing.assert_close(normal.amax(0), torch.ones(normal.shape[1]), atol=1e-3, rtol=0)
        torch.testing.assert_close(normal.amin(0), -torch.ones(normal.shape[1]), atol=1e-3, rtol=0)


def test_what_cannot_be_collected_is_named(tmp_path):
    with refused("quality"):
        collect(tmp_path / "mixed.h5", Collection("block_push", 1, quality="mixed"))
    with refused("task"):
        collect(tmp_path / "fly.h5", Collection("Fly", 1))
