"""Collecting demonstrations: layout, labels, and survival of a kill at any moment."""

import json
import time

import h5py
import numpy as np
import pytest
import torch

from tests.forked import FORKED
from tests.recipe_modules import run, started
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data import demo_workers, demos
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.data.demos import Collection, collect, read_initial_state
from torchrl_sparse.data.hdf5_writer import Episode
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import RobosuiteTask, find_robosuite_task
from torchrl_sparse.rotations import pose_to_absolute

THREE = Collection("Lift", episodes=3, seed=50)


@pytest.fixture(scope="module")
def env():
    made = RobosuiteEnv("Lift")
    yield made
    made.close()


@pytest.fixture(scope="module")
def collected(env, tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "lift.h5"
    return path, collect(path, THREE, env=env)


class Interrupted(Exception):
    pass


class FakeExpert:
    """Quick episodes in place of the simulator's; counts how often each seed was demonstrated."""

    def __init__(self, fails=()):
        self.seeds, self.fails = [], fails

    def __call__(self, task, env, seed, quality="proficient", driver=None):
        self.seeds.append(seed)
        length = 3 + seed % 4
        arrays = np.random.default_rng(seed).standard_normal((length, 7))
        flags = np.zeros(length)
        flags[-1] = success = seed not in self.fails
        observations = {"object": arrays[:, :2]}
        return Episode(
            seed,
            "fake",
            "lift the fake",
            success,
            "<xml/>",
            arrays,
            arrays,
            arrays,
            flags,
            flags.astype(np.int64),
            observations,
        )


@pytest.fixture
def fake(monkeypatch):
    expert = FakeExpert(fails={3, 5})
    monkeypatch.setattr(demos, "demonstrate", expert)
    monkeypatch.setattr(RobosuiteTask, "make", lambda task: None)
    return expert


def test_layout_is_the_documented_one(collected):
    path, summary = collected
    with h5py.File(path) as file:
        data = file["data"]
        assert sorted(data) == ["demo_0", "demo_1", "demo_2"]
        assert data.attrs["total"] == sum(demo.attrs["num_samples"] for demo in data.values())
        args = json.loads(data.attrs["env_args"])
        assert (args["env_name"], args["env_version"], args["type"]) == ("Lift", "1.5.2", 1)
        assert args["env_kwargs"]["controller_configs"]["body_parts"]["right"]["input_type"] == "absolute"
        for index, demo in enumerate(data.values()):
            steps = demo.attrs["num_samples"]
            assert (demo.attrs["seed"], demo.attrs["operator"]) == (50 + index, "proficient")
            assert json.loads(demo.attrs["ep_meta"]) == {"lang": "lift the red cube"}
            assert demo["actions"].shape == demo["executed_actions"].shape == (steps, 7)
            assert demo["states"].shape == (steps, 32)
            assert demo["rewards"][()].tolist() == demo["dones"][()].tolist() == [0] * (steps - 1) + [1]
            published = {"robot0_eef_quat"}  # which no policy of ours observes
            assert set(demo["obs"]) == set(find_robosuite_task("Lift").state_keys) | published
    assert (summary.attempts, summary.successes, summary.kept) == (3, 3, 3)
    assert str(summary).startswith("successes/attempts 3/3, kept 3, mean length ")


def test_the_reader_reads_it(collected):
    read = read_demos(collected[0], find_robosuite_task("Lift").state_keys)
    assert len(read) == 3
    assert read.data[keys.STATE].shape[1:] == (19,)


def test_labels_are_clean_and_executed_actions_are_not(collected, env):
    path, _ = collected
    with h5py.File(path) as file:
        demo = file["data/demo_0"]
        clean, executed, hand = (
            demo["actions"][()],
            demo["executed_actions"][()],
            demo["obs/robot0_eef_pos"][()],
        )
    offset = np.linalg.norm(executed[:, :3] - clean[:, :3], axis=1)
    assert (offset > 0).all()
    assert offset.mean() < 0.03
    assert (np.linalg.norm(clean[:, :3] - hand, axis=1) < 0.085).all()


def test_executed_actions_replay_to_the_same_states(collected, env):
    path, _ = collected
    with h5py.File(path) as file:
        demo = file["data/demo_1"]
        states, executed = demo["states"][()], demo["executed_actions"][()]
    td = env.reset(initial_state=read_initial_state(path, 1))
    for state, command in zip(states, executed, strict=True):
        np.testing.assert_allclose(env.sim_env.sim.get_state().flatten(), state, atol=1e-5)
        td[keys.ACTION] = torch.as_tensor(pose_to_absolute(command), dtype=torch.float32)
        td = env.step(td)["next"]
    assert td[keys.SUCCESS]


def test_an_episode_is_fixed_by_its_seed_alone(collected, env):
    again = demonstrate(
        find_robosuite_task("Lift"), env, seed=50
    )  # after other episodes in the same environment
    with h5py.File(collected[0]) as file:
        np.testing.assert_array_equal(file["data/demo_0/actions"], again.actions)
        np.testing.assert_array_equal(file["data/demo_0/states"], again.states)


def test_kill_9_and_run_again_gives_the_same_bytes(collected, tmp_path):
    path = tmp_path / "lift.h5"
    options = ("task=Lift", "episodes=3", "seed=50", f"out={path}")
    running = started("collect_demos", *options)
    first = tmp_path / "lift.h5.parts" / "0000000050.h5"
    deadline = time.monotonic() + 120
    while not first.exists() and time.monotonic() < deadline and running.is_alive():
        time.sleep(0.02)
    running.kill()
    running.join()
    assert first.exists()
    assert not path.exists()
    assert "successes/attempts 3/3" in run("collect_demos", *options)
    assert first.parent.exists() is False
    assert path.read_bytes() == collected[0].read_bytes()


def test_resumes_after_every_episode_with_nothing_lost_or_double(fake, tmp_path):
    whole = tmp_path / "whole.h5"
    collect(whole, Collection("Lift", episodes=6))
    assert fake.seeds == [0, 1, 2, 3, 4, 5, 6, 7]  # 3 and 5 fail
    for stop in range(1, 9):
        fake.seeds.clear()
        path = tmp_path / f"stopped_{stop}.h5"

        def interrupt(tally, stop=stop):
            if tally.attempts == stop:
                raise Interrupted

        with pytest.raises(Interrupted):
            collect(path, Collection("Lift", episodes=6), on_episode=interrupt)
        assert not path.exists()
        summary = collect(path, Collection("Lift", episodes=6))
        assert fake.seeds == [0, 1, 2, 3, 4, 5, 6, 7]
        assert (summary.attempts, summary.successes) == (8, 6)
        assert path.read_bytes() == whole.read_bytes()


def test_half_written_files_are_written_anew(fake, tmp_path):
    path, parts = tmp_path / "a.h5", tmp_path / "a.h5.parts"
    whole = tmp_path / "whole.h5"
    collect(whole, Collection("Lift", episodes=2))
    parts.mkdir()
    (parts / "settings.json").write_text(json.dumps(demos.asdict(Collection("Lift", episodes=2))))
    (parts / ".0000000000.tmp.h5").write_bytes(b"cut off")
    (tmp_path / ".a.tmp.h5").write_bytes(b"cut off")
    collect(path, Collection("Lift", episodes=2))
    assert path.read_bytes() == whole.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "whole.h5"]


def test_failures_are_kept_when_asked_for(fake, tmp_path):
    path = tmp_path / "all.h5"
    summary = collect(path, Collection("Lift", episodes=6, keep_failures=True))
    assert (summary.attempts, summary.successes, summary.kept) == (6, 4, 6)
    with h5py.File(path) as file:
        success = [bool(file[f"data/demo_{i}"].attrs["success"]) for i in range(6)]
    assert success == [True, True, True, False, True, False]


def test_a_finished_file_is_reported_not_made_again(fake, tmp_path):
    path = tmp_path / "a.h5"
    first = collect(path, Collection("Lift", episodes=2))
    fake.seeds.clear()
    assert collect(path, Collection("Lift", episodes=2)) == first
    assert fake.seeds == []


def test_a_longer_collection_extends_a_shorter_one(fake, tmp_path):
    whole, path = tmp_path / "whole.h5", tmp_path / "a.h5"
    collect(whole, Collection("Lift", episodes=6))
    shorter = collect(path, Collection("Lift", episodes=4))
    fake.seeds.clear()

    def interrupt(tally):
        if tally.attempts == 6:
            raise Interrupted

    with pytest.raises(Interrupted):
        collect(path, Collection("Lift", episodes=6), on_episode=interrupt)
    summary = collect(path, Collection("Lift", episodes=6))
    assert (shorter.kept, summary.kept) == (4, 6)
    assert fake.seeds == [3, 5, 6, 7]  # what failed, of which no file tells, and what is new
    assert path.read_bytes() == whole.read_bytes()
    with refused("a.h5"):
        collect(path, Collection("Lift", episodes=5))


def test_settings_alone_hold_nobody_up(fake, tmp_path):
    (tmp_path / "a.h5.parts").mkdir()
    (tmp_path / "a.h5.parts" / "settings.json").write_text('{"quality": "mixed"}')
    assert collect(tmp_path / "a.h5", Collection("Lift", episodes=1)).kept == 1


def test_other_settings_never_mix(fake, tmp_path):
    finished, stopped = tmp_path / "finished.h5", tmp_path / "stopped.h5"
    collect(finished, Collection("Lift", episodes=2))

    def interrupt(tally):
        raise Interrupted

    with pytest.raises(Interrupted):
        collect(stopped, Collection("Lift", episodes=2), on_episode=interrupt)
    for path in (finished, stopped):
        with refused("finished.h5" if path == finished else "stopped.h5.parts/settings.json"):
            collect(path, Collection("Lift", episodes=2, quality="mixed"))


def test_a_file_of_other_origin_is_refused(tmp_path):
    path = tmp_path / "human.h5"
    with h5py.File(path, "w") as file:
        file.create_group("data")
    with refused("human.h5: collection: task"):
        collect(path, THREE)


def test_an_expert_that_keeps_failing_stops_the_collection(monkeypatch, tmp_path, fake):
    fake.fails = range(100)
    with pytest.raises(RuntimeError, match="0/20"):
        collect(tmp_path / "a.h5", Collection("Lift", episodes=2))


@pytest.mark.parametrize(("field", "value"), [("episodes", 0), ("seed", -1), ("seed", 210_000)])
def test_out_of_range_options_are_named(tmp_path, field, value):
    with refused(field):
        collect(tmp_path / "a.h5", Collection(**{"task": "Lift", "episodes": 1, field: value}))


def test_two_workers_make_the_same_file(collected, tmp_path, backend, monkeypatch):
    path, summary = collected
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo_workers, "get_context", lambda _: FORKED)  # how they start is tested beside them
    assert collect("two.h5", THREE, workers=2, backend=backend) == summary
    assert (tmp_path / "two.h5").read_bytes() == path.read_bytes()


def test_no_worker_is_refused(tmp_path):
    with refused("workers"):
        collect(tmp_path / "none.h5", THREE, workers=0)
