"""A handful of rendered steps; skipped only where the system has no GL library."""

from contextlib import closing
from unittest import mock

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, keys
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.rendering import CameraRenderer
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


@pytest.mark.parametrize("camera", ["agentview", "robot0_eye_in_hand", "frontview", "birdview"])
def test_what_is_out_of_view_is_not_drawn_and_not_missed(env, camera):
    env.reset()
    for _ in range(3):
        env.step(env.rand_action())
        renderer = CameraRenderer(env.sim_env.sim, 48, 72)  # wider than tall
        fewer = renderer.image(camera)
        nothing = np.zeros(renderer._model.ngeom, bool)
        with mock.patch.object(renderer, "_out_of_view", return_value=nothing):
            assert np.array_equal(renderer.image(camera), fewer)
        hidden = renderer._out_of_view(renderer._model.camera(camera).id).sum()
        renderer.close()
        assert hidden > 30 or camera != "robot0_eye_in_hand"  # the hand's camera does not see the arm


def test_a_renderer_goes_on_with_the_next_episodes_model(env):
    env.reset()
    env.render("frontview", 40, 40)
    (renderer,) = (r for size, r in env._cameras._renderers.items() if size == (40, 40))
    env.reset(initial_state=env.get_initial_state())
    env.reset()
    image = env.render("frontview", 40, 40)
    assert env._cameras._renderers[40, 40] is renderer
    fresh = CameraRenderer(env.sim_env.sim, 40, 40)
    assert np.array_equal(fresh.image("frontview"), image)
    fresh.close()


def test_a_renderer_does_not_follow_into_another_scene(env):
    env.reset()
    renderer = CameraRenderer(env.sim_env.sim, 40, 40)
    other = RobosuiteEnv("PickPlaceCan", seeds=[0])
    other.reset()
    assert not renderer.follow(other.sim_env.sim)
    assert renderer.follow(env.sim_env.sim)
    renderer.close()
    other.close()


def test_unknown_camera_is_named(env):
    with refused("camera"):
        env.render("drone")


def test_frames_that_no_query_sees_are_not_rendered_and_change_nothing(env):
    policy = DiffusionPolicy.from_pretrained("assets/lift_image")
    policy.sampler = Sampler("ddpm", 2)
    make = diffusion_env("lift", policy)
    played = {}
    for seen in (None, policy.n_obs_steps):
        with (
            closing(make(seeds=[100000], seen_frames=seen)) as shown,
            mock.patch.object(
                CameraRenderer, "image", autospec=True, side_effect=CameraRenderer.image
            ) as image,
        ):
            played[seen] = shown.rollout(11, ChunkExecutor(policy, n_action_steps=4)), image.call_count
    (every, all_frames), (fewer, seen_frames) = played.values()
    assert torch.equal(every[keys.CHUNK], fewer[keys.CHUNK])
    assert torch.equal(every["next"][keys.STATE], fewer["next"][keys.STATE])
    # The first; after steps 0 to 10, those of the last two before each policy call, at 4, 8 and, to come, 12.
    assert (all_frames, seen_frames) == (2 * 12, 2 * 6)
    same = (every["next"][keys.IMAGE] == fewer["next"][keys.IMAGE]).flatten(1).all(1)
    assert same.tolist() == [False, False, True, True] * 2 + [False, False, True]


def test_no_frames_seen_at_all_is_refused():
    with refused("seen_frames"):
        RobosuiteEnv("Lift", camera="agentview", seen_frames=0)


def test_without_an_executor_every_frame_is_rendered():
    shown = RobosuiteEnv("Lift", camera="agentview", image_size=48, seeds=[0], seen_frames=1)
    with (
        closing(shown),
        mock.patch.object(CameraRenderer, "image", autospec=True, side_effect=CameraRenderer.image) as image,
    ):
        shown.rollout(3)
    assert image.call_count == 4
