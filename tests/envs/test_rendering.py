"""A handful of rendered steps; skipped only where the system has no GL library."""

import pytest
import torch
from torchrl.envs import check_env_specs

from torchrl_sparse import keys
from torchrl_sparse.envs.robosuite import RobosuiteEnv


@pytest.fixture(scope="module")
def env():
    env = RobosuiteEnv(
        "Lift", camera="agentview", wrist_camera="robot0_eye_in_hand", image_size=48, seeds=[0]
    )
    try:
        env.reset()
    except RuntimeError as error:
        pytest.skip(str(error))
    yield env
    env.close()


def test_cameras_are_written_on_the_canonical_keys(env):
    check_env_specs(env)
    td = env.reset()
    for key in (keys.IMAGE, keys.WRIST_IMAGE):
        assert td[key].shape == (3, 48, 48)
        assert td[key].dtype == torch.uint8
        assert td[key].float().std() > 10  # something is in the picture
    assert not torch.equal(td[keys.IMAGE], td[keys.WRIST_IMAGE])


def test_image_is_upright_and_follows_the_scene(env):
    env.reset()
    before = env.render("frontview", 64, 64)
    table, floor_or_wall = before[45:50, 25:40].mean(), before[:5].mean()
    assert table > floor_or_wall  # the white table is in the lower half
    sim = env.sim_env.sim
    pose = sim.data.get_joint_qpos(env.sim_env.cube.joints[0]).copy()
    pose[0] += 0.2
    sim.data.set_joint_qpos(env.sim_env.cube.joints[0], pose)
    sim.forward()
    assert (env.render("frontview", 64, 64) != before).any()


def test_unknown_camera_is_named(env):
    with pytest.raises(ValueError, match=r"camera: expected one of .*agentview.*got 'drone'"):
        env.render("drone")
