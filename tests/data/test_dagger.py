"""DAgger: who drives which steps, what is learned from an episode, what is dropped, and resumption."""

import pickle
from functools import partial

import h5py
import numpy as np
import pytest
import torch
from torchrl.data import Unbounded

from tests.policies.diffusion.conftest import make_image_policy  # noqa: F401  a fixture
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, keys
from torchrl_sparse.data import demos
from torchrl_sparse.data.dagger import Driver, Driving
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.data.demos import Collection, collect, read_initial_state
from torchrl_sparse.data.robomimic import join_demos, read_demos
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.tasks import TASKS, StateTask
from torchrl_sparse.rotations import pose_to_absolute

PIT = -0.4  # beyond which nobody gets out
DRIFT = -0.031  # what the policy does, whatever it sees
TOY = Driving("nowhere", "toy", n_action_steps=4, mixing=0.3)


class Line(SeededEnv):
    """A point on a line that is to go to 1; an action is how far it moves."""

    def __init__(self, **kwargs):
        super().__init__(**{"horizon": 60, **kwargs})
        self._make_specs(1, Unbounded((1,)))

    def _start(self, seed):
        self._at = np.random.default_rng(seed).uniform(-0.3, 0.95)

    def _advance(self, action):
        self._at += 0.0 if self._at < PIT else float(action[0])
        return 0.0

    def _observe_state(self):
        return np.array([self._at])

    def _is_solved(self):
        return self._at > 0.98


class Walker:
    noise = 0.004

    def __init__(self, rng):
        pass

    def command(self, state):
        return np.clip(1.0 - state, -0.05, 0.05)


class Drifting:
    """In place of a policy's executor. Where it may, it gets there alone."""

    def __init__(self, solves=()):
        self.solves, self.seed, self.seen = solves, None, []

    def reset(self, seed):
        self.seed, self.seen = seed, []

    def act(self, observation):
        self.seen.append(float(observation["state"][0]))
        return np.array([0.2 if self.seed in self.solves else DRIFT], np.float32)


@pytest.fixture
def toy(monkeypatch):
    task = StateTask("Line", "line", 1, 1, f"{__name__}:Line", f"{__name__}:Walker")
    monkeypatch.setitem(TASKS, "Line", task)
    actor = Drifting(solves={7, 8})
    monkeypatch.setattr(demos, "load_driver", lambda name, driving: Driver(driving, actor))
    return task


def collection(**changes):
    return Collection(**{"task": "Line", "episodes": 8, "driving": TOY, **changes})


def read_episode(group):
    return {name: group[name][()] for name in ("actions", "executed_actions", "obs/state")} | dict(
        group.attrs
    )


def test_the_policy_drives_as_drawn_and_then_the_expert_acts_for_itself(toy):
    for seed in range(12):
        actor, env = Drifting(), toy.make()
        episode = demonstrate(toy, env, seed, driver=Driver(TOY, actor))
        driven = TOY.draw_steps(seed, env.horizon // 2)
        state, executed = episode.observations["state"], episode.executed_actions
        assert episode.driven == driven == len(actor.seen)
        assert actor.seen == state[:driven, 0].astype(np.float32).tolist()
        np.testing.assert_allclose(executed[:driven], DRIFT, rtol=1e-6)
        # whoever drives, the label is what the expert would do there
        np.testing.assert_array_equal(episode.actions, np.stack([Walker(None).command(s) for s in state]))
        shift = np.abs(executed - episode.actions)[driven:]
        assert ((shift > 0) & (shift < 0.03)).all()


def test_no_window_begins_while_the_policy_drives_and_none_has_its_actions(toy, tmp_path):
    collect(tmp_path / "a.h5", collection())
    read = read_demos(tmp_path / "a.h5", ("state",), poses=False)
    with h5py.File(tmp_path / "a.h5") as file:
        episodes = [read_episode(file[f"data/demo_{index}"]) for index in range(len(read))]
    assert read.driven.tolist() == [episode["driven"] for episode in episodes]
    assert min(read.driven) >= TOY.n_action_steps
    for sizes in ((10, 2, 9), (6, 3, 4), (4, 1, 4)):
        rows = read.window_rows(*sizes)
        expected = []
        for start, end, driven in zip(read.starts, read.starts[1:], read.driven, strict=False):
            # a demonstration that begins where the expert took over, with the policy's steps as its past
            for present in range(int(start + driven), int(end)):
                window = np.arange(sizes[0]) + present - (sizes[1] - 1)
                expected.append(window.clip(int(start), int(end) - 1).tolist())
        assert rows.tolist() == expected
        batch = read.windows(rows, sizes[1])
        assert (batch[keys.ACTION] - DRIFT).abs().min() > 0.01
        torch.testing.assert_close(batch[keys.ACTION], (1.0 - read.data[keys.STATE][rows]).clamp(-0.05, 0.05))


def test_history_of_the_first_query_is_what_the_policy_saw(toy, tmp_path):
    collect(tmp_path / "a.h5", collection(episodes=3))
    read = read_demos(tmp_path / "a.h5", ("state",), poses=False)
    for index in range(3):
        first = read.window_rows(6, 3, 4, [index])[0]
        past = read.windows(first[None], 3)[keys.HISTORY_STATE][0, :, 0]
        np.testing.assert_allclose(past.diff(), DRIFT, rtol=1e-4)


def test_what_teaches_nothing_is_dropped_and_counted(toy, tmp_path):
    summary = collect(tmp_path / "a.h5", collection(episodes=20, keep_failures=True))
    with h5py.File(tmp_path / "a.h5") as file:
        made = [read_episode(file[f"data/demo_{index}"]) for index in range(20)]
    alone = [bool(one["success"]) and one["driven"] == one["num_samples"] for one in made]
    assert [index for index, is_alone in enumerate(alone) if is_alone] == [7, 8]
    lost = [not one["success"] for one in made]
    assert 0 < sum(lost) < 18
    assert (summary.attempts, summary.successes, summary.kept) == (20, 20 - sum(lost), 20)
    assert summary.alone == 2
    assert f"successes/attempts {20 - sum(lost)}/20 (2 by the policy alone)" in str(summary)
    taught = [index for index in range(20) if not (lost[index] or alone[index])]
    kept = collect(tmp_path / "b.h5", collection(episodes=len(taught)))
    with h5py.File(tmp_path / "b.h5") as file:
        assert [file[f"data/demo_{index}"].attrs["seed"] for index in range(kept.kept)] == taught
    assert (kept.attempts, kept.alone) == (taught[-1] + 1, 2)


def test_a_policy_that_needs_no_expert_ends_the_collection(toy, monkeypatch, tmp_path):
    monkeypatch.setattr(demos, "load_driver", lambda name, driving: Driver(driving, Drifting(range(99))))
    with pytest.raises(
        RuntimeError, match=r"the policy needs no expert: .* 2\d/2\d \(2\d by the policy alone"
    ):
        collect(tmp_path / "a.h5", collection(driving=Driving("nowhere", "toy", mixing=0.0)))


def test_resumes_after_every_episode_to_the_same_bytes(toy, tmp_path):
    whole = collect(tmp_path / "whole.h5", collection())

    class Interrupted(Exception):
        pass

    for stop in range(1, whole.attempts + 1, 4):
        path = tmp_path / f"stopped_{stop}.h5"

        def interrupt(tally, stop=stop):
            if tally.attempts == stop:
                raise Interrupted

        with pytest.raises(Interrupted):
            collect(path, collection(), on_episode=interrupt)
        others = Driving("nowhere", "other weights", n_action_steps=4, mixing=0.3)
        with refused("settings.json"):
            collect(path, collection(driving=others))
        assert collect(path, collection()) == whole
        assert path.read_bytes() == (tmp_path / "whole.h5").read_bytes()
    with refused("stopped_9.h5"):
        collect(path, collection(driving=None))


def test_the_expert_takes_over_sooner_the_more_is_mixed_in():
    means = []
    for mixing in (0.02, 0.1, 0.5):
        driving = Driving("nowhere", "toy", n_action_steps=8, mixing=mixing)
        steps = np.array([driving.draw_steps(seed, 10_000) for seed in range(400)])
        assert (steps % 8 == 0).all()
        assert steps.min() == 8
        means.append(steps.mean())
    np.testing.assert_allclose(means, [8 / 0.02, 8 / 0.1, 8 / 0.5], rtol=0.15)
    assert Driving("nowhere", "toy", mixing=0.0).draw_steps(0, 200) == 200
    assert {Driving("nowhere", "toy", mixing=1.0).draw_steps(seed, 200) for seed in range(9)} == {8}


@pytest.mark.parametrize(("field", "value"), [("mixing", -0.1), ("mixing", 1.5), ("n_action_steps", 0)])
def test_out_of_range_options_are_named(field, value):
    with refused(field):
        Driving("nowhere", "toy", **{field: value})


def test_a_file_that_claims_more_driven_steps_than_it_has_is_refused(toy, tmp_path):
    collect(tmp_path / "a.h5", collection(episodes=2))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["data/demo_1"].attrs["driven"] = 10_000
    with refused("a.h5, demo_1, driven"):
        read_demos(tmp_path / "a.h5", ("state",), poses=False)


def test_joined_files_are_cut_as_each_alone(toy, tmp_path):
    collect(tmp_path / "alone.h5", collection(episodes=3, driving=None, seed=100))
    collect(tmp_path / "driven.h5", collection(episodes=4))
    parts = [
        read_demos(tmp_path / f"{name}.h5", ("state",), poses=False) for name in ("alone", "driven", "alone")
    ]
    joined = join_demos(parts)
    assert len(joined) == 10
    cut = partial(torch.cat, dim=0)
    rows = [part.window_rows(6, 2, 4) for part in parts]
    windows = [part.windows(row, 2) for part, row in zip(parts, rows, strict=True)]
    whole = joined.windows(joined.window_rows(6, 2, 4), 2)
    for key in (keys.HISTORY_STATE, keys.ACTION):
        assert torch.equal(whole[key], cut([window[key] for window in windows]))
    other = type(parts[0])(parts[0].data.exclude(keys.ACTION), parts[0].starts)
    with refused("demos"):
        join_demos([parts[0], other])


@pytest.fixture(scope="module")
def driving():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    return Driving("assets/lift", policy.fingerprint, "ddpm3_logsnr", mixing=0.5)


def test_a_policy_of_lift_drives_and_its_episodes_replay(driving, tmp_path):
    two = Collection("Lift", episodes=2, seed=300, driving=driving)
    env = RobosuiteEnv("Lift")
    assert pickle.loads(pickle.dumps(two)) == two  # as workers are handed it
    summary = collect(tmp_path / "one.h5", two, env=env)
    assert collect(tmp_path / "two.h5", pickle.loads(pickle.dumps(two)), env=env) == summary
    assert (tmp_path / "two.h5").read_bytes() == (tmp_path / "one.h5").read_bytes()
    with h5py.File(tmp_path / "one.h5") as file:
        demo = file["data/demo_0"]
        driven, states, executed = demo.attrs["driven"], demo["states"][()], demo["executed_actions"][()]
        labels, hand = demo["actions"][()], demo["obs/robot0_eef_pos"][()]
    assert 8 <= driven < len(states)
    assert (np.linalg.norm(labels[:, :3] - hand, axis=1) < 0.085).all()  # the expert's reach, in every state
    td = env.reset(initial_state=read_initial_state(tmp_path / "one.h5", 0))
    for state, command in zip(states, executed, strict=True):
        np.testing.assert_allclose(env.sim_env.sim.get_state().flatten(), state, atol=1e-5)
        td[keys.ACTION] = torch.as_tensor(pose_to_absolute(command), dtype=torch.float32)
        td = env.step(td)["next"]
    assert td[keys.SUCCESS]
    env.close()


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("Lift", {"fingerprint": "other"}, "policy: expected the weights other in assets/lift, got"),
        ("Lift", {"method": "nothing"}, "methods: expected dense"),
        ("Lift", {"method": "bac"}, "method: expected one that needs no calibration"),
        ("Lift", {"policy": "assets/none"}, "assets/none"),
        ("PickPlaceCan", {}, "policy: expected one of 23 observed numbers"),
    ],
)
def test_a_policy_that_cannot_drive_is_refused_before_anything_is_written(
    driving, tmp_path, task, changes, message
):
    wrong = type(driving)(**{**demos.asdict(driving), **changes})
    with pytest.raises((ValueError, OSError), match=message):
        collect(tmp_path / "a.h5", Collection(task, episodes=1, driving=wrong))
    assert not [*tmp_path.iterdir()]
