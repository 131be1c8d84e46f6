"""Three cubes, one of them named: scene and words follow from the seed, and only the named cube counts."""

from dataclasses import replace
from itertools import combinations

import h5py
import numpy as np
import pytest
from torchrl.envs import SerialEnv

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.control.realtime_executor import HoldPose
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.data.demos import Collection, collect, read_initial_state
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.envs.named_lift import COLOURS, SPACING, X_RANGE, Y_RANGE
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task, find_task

WORDS = [f"lift the {colour} cube" for colour in COLOURS]


@pytest.fixture(scope="module")
def env():
    env = RobosuiteEnv("lift_named", instruction=True)
    yield env
    env.close()


def start(env, seed):
    env.set_seed(seed)
    return env.reset()


def places(env):
    """f64 [3, 3] of the cubes, m."""
    sim = env.sim_env.sim
    return np.stack(
        [sim.data.body_xpos[sim.model.body_name2id(cube.root_body)] for cube in env.sim_env.cubes.values()]
    )


def succeeds_with(env, state, colour):
    """Whether the episode from ``state`` ends in success when this cube is up in the air."""
    td = env.reset(initial_state=state)
    sim, joint = env.sim_env.sim, env.sim_env.cubes[colour].joints[0]
    pose = sim.data.get_joint_qpos(joint).copy()
    sim.data.set_joint_qpos(joint, [*pose[:2], 1.2, *pose[3:]])
    sim.forward()
    td = env.step(td.set(keys.ACTION, HoldPose(env.task.pose_slices())(td.clone())[keys.HOLD]))["next"]
    return bool(td[keys.SUCCESS])


@pytest.fixture(scope="module")
def drawn(env):
    """What a dozen seeds draw: instruction, and f64 [3, 3] of the cubes."""
    return [(start(env, seed)[keys.INSTRUCTION], places(env)) for seed in range(12)]


@pytest.fixture(scope="module")
def other(drawn):
    """A seed that asks for something else than seed 0."""
    return next(seed for seed, (words, _) in enumerate(drawn) if words != drawn[0][0])


def test_a_seed_fixes_scene_and_instruction(env, drawn):
    for seed in (7, 2, 0):
        assert start(env, seed)[keys.INSTRUCTION] == drawn[seed][0]
        np.testing.assert_array_equal(places(env), drawn[seed][1])
    assert {words for words, _ in drawn} == set(WORDS)
    assert all(np.abs(one - two).max() > 0.01 for (_, one), (_, two) in combinations(drawn, 2))


def test_cubes_lie_apart_on_the_table(drawn):
    low, high = np.transpose([X_RANGE, Y_RANGE])
    for _, scene in drawn:
        centres = scene[:, :2]
        assert (centres >= low).all()
        assert (centres <= high).all()
        assert min(np.linalg.norm(a - b) for a, b in combinations(centres, 2)) >= SPACING


def test_the_instruction_decides_which_cube_counts_in_the_same_scene(env):
    start(env, 3)
    state = env.get_initial_state()
    won = [[succeeds_with(env, replace(state, instruction=w), c) for c in COLOURS] for w in WORDS]
    np.testing.assert_array_equal(won, np.eye(3, dtype=bool))


def test_words_of_the_caller_replace_those_drawn_and_nothing_else(env):
    start(env, 4)
    scene = places(env)
    for words in WORDS:
        fixed = RobosuiteEnv("LiftNamed", instruction=words, seeds=[4])
        assert fixed.reset()[keys.INSTRUCTION] == words
        np.testing.assert_array_equal(places(fixed), scene)
        fixed.close()


def test_a_saved_start_keeps_its_instruction(env, drawn, other):
    start(env, 0)
    state = env.get_initial_state()
    assert start(env, other)[keys.INSTRUCTION] != drawn[0][0]
    assert env.reset(initial_state=state)[keys.INSTRUCTION] == drawn[0][0]


def test_the_state_is_that_of_the_named_cube(env):
    td = start(env, 5)
    named = places(env)[WORDS.index(td[keys.INSTRUCTION])]
    np.testing.assert_allclose(td[keys.STATE][:3], named, atol=1e-6)
    assert td[keys.STATE].shape == (find_robosuite_task("LiftNamed").state_dim,)


def test_unknown_words_are_refused(env):
    with refused("instruction"):
        RobosuiteEnv("LiftNamed", instruction="lift it")
    start(env, 0)
    state = replace(env.get_initial_state(), instruction="lift the pink cube")
    with refused("instruction"):
        env.reset(initial_state=state)


def test_each_environment_of_a_batch_has_its_own_words(drawn):
    def make(**options):
        return RobosuiteEnv("LiftNamed", instruction=True, action_mode="delta", **options)

    # One ends at every step, the other at every second, so that resets are partial ones too.
    options = [{"seeds": [0, 1, 2, 3], "horizon": 1}, {"seeds": [4, 5, 6, 7], "horizon": 2}]
    batch = SerialEnv(2, make, create_env_kwargs=options)
    steps = batch.rollout(4, break_when_any_done=False)
    seeds = steps[keys.EPISODE_SEED].squeeze(-1)
    assert [len(row.unique()) for row in seeds] == [4, 2]
    for index, row in enumerate(steps.unbind(0)):
        for step, td in enumerate(row.unbind(0)):
            assert td[keys.INSTRUCTION] == drawn[seeds[index, step]][0]
    batch.close()


def test_the_expert_lifts_the_named_cube_and_leaves_the_others(env):
    for seed in range(30_000, 30_003):
        assert demonstrate(find_task("lift_named"), env, seed).success
        named = WORDS.index(env.instruction)
        heights = places(env)[:, 2]
        assert heights[named] > 0.84
        assert np.delete(heights, named).max() < 0.83


def test_demonstrations_tell_what_they_were_asked(env, tmp_path):
    path = tmp_path / "named.h5"
    collect(path, Collection("LiftNamed", episodes=2, seed=50), env=env)
    found = read_instructions(path)
    with h5py.File(path) as file:
        seeds = [int(file[f"data/demo_{index}"].attrs["seed"]) for index in range(2)]
    assert found == [start(env, seed)[keys.INSTRUCTION] for seed in seeds]
    assert read_initial_state(path, 1).instruction == found[1]
