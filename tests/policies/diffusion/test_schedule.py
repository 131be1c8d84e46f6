"""Denoising steps against diffusers' own, with the noise handed in."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler

from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule

PUBLISHED = {
    "num_train_timesteps": 100,
    "beta_schedule": "squaredcos_cap_v2",
    "clip_sample": True,
    "prediction_type": "epsilon",
}
SHAPE = (2, 10, 10)


@pytest.mark.parametrize("steps", [100, 25, 10])
def test_ddpm_equals_diffusers_with_its_variance_noise(steps):
    schedule = NoiseSchedule("ddpm", steps)
    reference = DDPMScheduler(variance_type="fixed_small", **PUBLISHED)
    reference.set_timesteps(steps)
    assert torch.equal(schedule.timesteps, reference.timesteps)
    drawn, handed = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    ours = theirs = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    for k, timestep in enumerate(reference.timesteps):
        eps = torch.randn(SHAPE, generator=torch.Generator().manual_seed(100 + k))
        theirs = reference.step(eps, timestep, theirs, generator=drawn).prev_sample
        noise = torch.randn(SHAPE, generator=handed) if k < steps - 1 else None
        ours = schedule.step(eps, k, ours, noise)
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("steps", [100, 33, 10, 1])
def test_ddim_equals_diffusers_and_reads_no_noise(steps):
    schedule = NoiseSchedule("ddim", steps)
    reference = DDIMScheduler(**PUBLISHED)
    reference.set_timesteps(steps)
    ours = theirs = torch.randn(SHAPE)
    for k, timestep in enumerate(reference.timesteps):
        eps = torch.randn(SHAPE)
        theirs = reference.step(eps, timestep, theirs).prev_sample
        ours = schedule.step(eps, k, ours, torch.full(SHAPE, torch.nan))
        assert torch.equal(ours, theirs)


def test_published_timesteps_run_from_99_to_0():
    assert NoiseSchedule().timesteps.tolist() == list(range(99, -1, -1))


@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_the_true_noise_leads_back_to_the_clean_sample(kind):
    schedule = NoiseSchedule(kind, 20)
    clean = torch.rand(SHAPE) * 2 - 1
    sample = torch.randn(SHAPE)
    alphas = schedule.scheduler.alphas_cumprod
    for k, timestep in enumerate(schedule.timesteps):
        eps = (sample - alphas[timestep].sqrt() * clean) / (1 - alphas[timestep]).sqrt()
        sample = schedule.step(eps, k, sample, torch.randn(SHAPE))
    torch.testing.assert_close(sample, clean, atol=1e-4, rtol=0)


def test_add_noise_mixes_by_the_cumulative_alpha():
    schedule = NoiseSchedule()
    clean, noise, timestep = torch.randn(3, 4, 2), torch.randn(3, 4, 2), torch.tensor([0, 50, 99])
    alpha = schedule.scheduler.alphas_cumprod[timestep][:, None, None]
    expected = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise
    torch.testing.assert_close(schedule.add_noise(clean, noise, timestep), expected)


def test_config_rebuilds_the_schedule():
    schedule = NoiseSchedule("ddim", 7, 50)
    again = NoiseSchedule(**schedule.config)
    assert repr(again) == repr(schedule)
    assert torch.equal(again.timesteps, schedule.timesteps)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match='kind must be "ddpm" or "ddim", got \'flow\''):
        NoiseSchedule("flow")
    with pytest.raises(ValueError, match=r"in 1\.\.100 .*got 101"):
        NoiseSchedule("ddim", 101)
    schedule, sample = NoiseSchedule(), torch.zeros(SHAPE)
    with pytest.raises(ValueError, match=r"k=3 .*needs noise_k"):
        schedule.step(sample, 3, sample)
    with pytest.raises(IndexError, match=r"0\.\.99, got 100"):
        schedule.step(sample, 100, sample)
