"""Flow's steps are Euler's, its noising is a straight line, and it is no other network's sampler."""

from itertools import pairwise

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler


@pytest.mark.parametrize("sampler", [Sampler("flow", 5), Sampler("flow", timesteps=[0, 0.25, 0.7])], ids=str)
def test_steps_are_eulers(sampler):
    def velocity(x, time):
        return torch.sin(3 * x) + time

    x = y = torch.randn(2, 4, 3, dtype=torch.float64)
    times = [*sampler.timesteps.tolist(), 1.0]
    for step, (time, after) in enumerate(pairwise(times)):
        x = sampler.step(velocity(x, time), step, x)
        y = y + (after - time) * velocity(y, time)
    torch.testing.assert_close(x, y, atol=1e-6, rtol=0)


def test_a_true_velocity_leads_to_the_data_in_any_number_of_steps():
    data, noise = torch.randn(2, 4, 3), torch.randn(2, 4, 3)
    for number in (1, 3, 10):
        sampler, x = Sampler("flow", number), noise
        for step, time in enumerate(sampler.timesteps):
            torch.testing.assert_close(x, sampler.add_noise(data, noise, time.expand(2)), atol=1e-5, rtol=0)
            x = sampler.step(data - noise, step, x)
        torch.testing.assert_close(x, data, atol=1e-5, rtol=0)


def test_a_guide_that_pulls_all_the_way_is_reached():
    sampler, x = Sampler("flow", 4), torch.randn(1, 4, 3)
    guide = Guide(torch.randn(1, 4, 3), torch.ones(1, 4, 1))
    for step in range(4):
        x = sampler.step(torch.randn(1, 4, 3), step, x, guide=guide)
    torch.testing.assert_close(x, guide.actions)


def test_its_names_and_arguments_come_back():
    for name in ("flow", "flow_0_0.25_0.7"):
        sampler = Sampler.from_name(name)
        assert sampler.name == name
        assert Sampler(**sampler.config).timesteps.tolist() == sampler.timesteps.tolist()
    assert Sampler.from_name("flow10").num_inference_steps == 10
    assert Sampler("flow", 4).last_steps(2).timesteps.tolist() == [0.5, 0.75]
    assert Sampler("flow", 200).num_inference_steps == 200


@pytest.mark.parametrize(
    ("arguments", "entry"),
    [
        ({"kind": "flow", "timesteps": [0.5, 0.2]}, "timesteps"),
        ({"kind": "flow", "timesteps": [0.0, 1.0]}, "timesteps"),
        ({"kind": "flow", "timesteps": [float("nan")]}, "timesteps"),
        ({"kind": "flow", "timesteps": [True]}, "timesteps"),
        ({"kind": "flow", "spacing": "logsnr"}, "spacing"),
        ({"kind": "flow", "eta": 1.0}, "eta"),
        ({"kind": "flow", "prediction": "epsilon"}, "prediction"),
        ({"kind": "ddpm", "prediction": "velocity"}, "prediction"),
        ({"kind": "ddpm", "clip_sample_range": 0}, "clip_sample_range"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments, entry):
    with refused(entry):
        Sampler(**arguments)


@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
@pytest.mark.parametrize("clip", [1.0, None])
def test_a_network_that_predicts_the_sample_steps_as_diffusers(kind, clip):
    schedulers = pytest.importorskip("diffusers.schedulers")
    options = {"beta_schedule": "squaredcos_cap_v2", "num_train_timesteps": 100, "prediction_type": "sample"}
    theirs = {"ddpm": schedulers.DDPMScheduler, "ddim": schedulers.DDIMScheduler}[kind](
        **options, clip_sample=bool(clip)
    )
    theirs.set_timesteps(10)
    ours = Sampler(kind, 10, clip_sample_range=clip, prediction="sample")
    x = torch.randn(2, 4, 3)
    for step, timestep in enumerate(theirs.timesteps):
        predicted = 2 * torch.randn(2, 4, 3)
        expected = theirs.step(
            predicted, timestep, x, generator=torch.Generator().manual_seed(step)
        ).prev_sample
        gaussian = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(step))
        torch.testing.assert_close(ours.step(predicted, step, x, gaussian), expected, atol=2e-6, rtol=1e-6)
        x = expected
