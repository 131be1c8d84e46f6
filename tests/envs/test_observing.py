"""Observations of which only what is asked for is computed, against all of robosuite's, at every step."""

import numpy as np
import pytest

from torchrl_sparse.envs.observing import OBJECTS, Observed
from torchrl_sparse.envs.simulator import make_simulator, site_twist
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, find_robosuite_task

ROBOSUITE = [task.name for task in TASKS.values() if isinstance(task, RobosuiteTask)]


def names_of(task):
    return [OBJECTS if name == "object" else name for name in task.state_keys]


@pytest.mark.parametrize("name", ROBOSUITE)
def test_what_is_read_is_what_robosuite_observes(name):
    task = find_robosuite_task(name)
    ours, theirs = (make_simulator(task, absolute=False) for _ in range(2))
    observed, rng = Observed(ours), np.random.default_rng(0)
    for seed in (0, 1):
        for sim_env in (ours, theirs):
            sim_env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            sim_env.reset()
        for _ in range(5):
            action = rng.uniform(-1, 1, theirs.action_dim)
            ours.step(action)
            theirs.step(action)
            theirs._update_observables(force=True)
            expected = theirs._get_observations(force_update=True)
            for names in (names_of(task), ["robot0_eef_quat"], [OBJECTS]):
                found = observed.read(names)
                for each in names:
                    assert np.array_equal(found[each], expected[each]), each
            for each in found.keys() - {OBJECTS}:
                assert np.array_equal(found[each], expected[each]), each


def test_what_is_not_asked_for_is_not_computed():
    sim_env = make_simulator(find_robosuite_task("Lift"), absolute=False)
    observed = Observed(sim_env)
    observed.read(["robot0_eef_pos"])
    sim_env.modify_observable("cube_pos", "corrupter", lambda seen: pytest.fail("asked for"))
    observed.read(["robot0_eef_pos"])


def test_what_another_observable_reads_is_computed_too_and_noise_is_kept():
    sim_env = make_simulator(find_robosuite_task("Lift"), absolute=False)
    observed = Observed(sim_env)
    before = observed.read(["gripper_to_cube_pos"])["gripper_to_cube_pos"]
    sim_env.modify_observable("cube_pos", "corrupter", lambda seen: seen + 1.0)
    after = observed.read(["gripper_to_cube_pos"])["gripper_to_cube_pos"]
    np.testing.assert_allclose(after - before, 1.0)


def test_an_unknown_name_is_a_key_error():
    with pytest.raises(KeyError, match="robot3_eef_pos"):
        Observed(make_simulator(find_robosuite_task("Lift"), absolute=False)).read(["robot3_eef_pos"])


def test_the_twist_of_a_site_is_robosuites():
    sim_env = make_simulator(find_robosuite_task("Lift"), absolute=False)
    for _ in range(3):
        sim_env.step(np.full(7, 0.4))
    (site,) = (robot.gripper["right"].important_sites["grip_site"] for robot in sim_env.robots)
    data = sim_env.sim.data
    expected = [*data.get_site_xvelp(site), *data.get_site_xvelr(site)]
    assert np.array_equal(site_twist(sim_env.sim, site), expected)
