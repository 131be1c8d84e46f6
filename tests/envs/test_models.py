"""Models that outlive resets against models that robosuite compiles fresh, byte for byte."""

import mujoco
import numpy as np
import pytest

from torchrl_sparse.envs import simulator
from torchrl_sparse.envs.models import compile_what_changes
from torchrl_sparse.envs.simulator import make_simulator
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, find_robosuite_task

ROBOSUITE = [task.name for task in TASKS.values() if isinstance(task, RobosuiteTask)]


def whole(sim_env):
    """All bytes of the compiled model."""
    model = sim_env.sim.model._model
    into = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, into)
    return into


def start(sim_env, seed):
    sim_env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
    sim_env.reset()


def pair(name, monkeypatch, absolute=True):
    task = find_robosuite_task(name)
    with monkeypatch.context() as patch:
        patch.setattr(simulator, "compile_what_changes", lambda _: None)
        fresh = make_simulator(task, absolute=absolute)
    return make_simulator(task, absolute=absolute), fresh


@pytest.mark.parametrize("name", ROBOSUITE)
def test_models_and_states_of_successive_episodes_are_those_of_robosuite(name, monkeypatch):
    kept, fresh = pair(name, monkeypatch)
    for seed in (0, 1, 2, 1):
        start(kept, seed)
        start(fresh, seed)
        assert np.array_equal(whole(kept), whole(fresh))
        assert np.array_equal(kept.sim.get_state().flatten(), fresh.sim.get_state().flatten())
        assert kept.sim.model.get_xml() == fresh.sim.model.get_xml()


@pytest.mark.parametrize("name", ["Lift", "PickPlaceCan"])
def test_meshes_are_compiled_once(name):
    sim_env = make_simulator(find_robosuite_task(name), absolute=True)
    start(sim_env, 0)
    model = sim_env.sim.model._model
    start(sim_env, 1)
    assert sim_env.sim.model._model is model


def test_what_an_episode_changes_in_its_model_is_gone_in_the_next(monkeypatch):
    kept, fresh = pair("PickPlaceCan", monkeypatch)
    for sim_env in (kept, fresh):
        start(sim_env, 0)
        model = sim_env.sim.model._model
        model.body_mass[:] *= 2
        model.geom_rgba[:] = 0.5
        model.opt.gravity[2] = -1.0
        model.opt.timestep = 0.001
        model.stat.meaninertia = 3.0
        start(sim_env, 1)
    assert np.array_equal(whole(kept), whole(fresh))


def test_another_scene_is_compiled_whole(monkeypatch):
    kept, fresh = pair("Lift", monkeypatch)
    for sim_env in (kept, fresh):
        start(sim_env, 0)
        sim_env._xml_processors.append(
            lambda xml: xml.replace('mesh="', 'friction="0.3 0.005 0.0001" mesh="', 1)
        )
        start(sim_env, 1)
    assert np.array_equal(whole(kept), whole(fresh))
    for sim_env in (kept, fresh):
        sim_env._xml_processors[-1] = lambda xml: xml.replace(
            ' name="cube_main"', ' name="cube_main" gravcomp="1"'
        )
        start(sim_env, 2)
        sim_env._xml_processors[-1] = lambda xml: xml.replace('timestep="0.002"', 'timestep="0.004"')
        start(sim_env, 3)
    assert np.array_equal(whole(kept), whole(fresh))


def test_a_simulator_that_makes_its_models_itself_keeps_that():
    sim_env = make_simulator(find_robosuite_task("Lift"), absolute=True)
    del sim_env._initialize_sim

    class Own(type(sim_env)):
        def _initialize_sim(self, xml_string=None):
            return super()._initialize_sim(xml_string)

    sim_env.__class__ = Own
    compile_what_changes(sim_env)
    assert "_initialize_sim" not in vars(sim_env)
