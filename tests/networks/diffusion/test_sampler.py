"""Denoising steps against diffusers' own, with the noise handed in."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler

from torchrl_sparse.networks.diffusion.sampler import Sampler

PUBLISHED = {
    "num_train_timesteps": 100,
    "beta_schedule": "squaredcos_cap_v2",
    "clip_sample": True,
    "prediction_type": "epsilon",
}
SHAPE = (2, 10, 10)


@pytest.mark.parametrize("steps", [100, 25, 16, 10, 1])
def test_ddpm_equals_diffusers_with_its_variance_noise(steps):
    sampler = Sampler("ddpm", steps)
    reference = DDPMScheduler(variance_type="fixed_small", **PUBLISHED)
    reference.set_timesteps(steps)
    assert torch.equal(sampler.timesteps, reference.timesteps)
    drawn, handed = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    ours = theirs = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    for k, timestep in enumerate(reference.timesteps):
        eps = torch.randn(SHAPE, generator=torch.Generator().manual_seed(100 + k))
        theirs = reference.step(eps, timestep, theirs, generator=drawn).prev_sample
        noise = torch.randn(SHAPE, generator=handed) if k < steps - 1 else None
        ours = sampler.step(eps, k, ours, noise)
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("steps", [100, 33, 10, 7, 1])
def test_ddim_equals_diffusers_and_reads_no_noise(steps):
    sampler = Sampler("ddim", steps)
    reference = DDIMScheduler(**PUBLISHED)
    reference.set_timesteps(steps)
    ours = theirs = torch.randn(SHAPE)
    for k, timestep in enumerate(reference.timesteps):
        eps = torch.randn(SHAPE)
        theirs = reference.step(eps, timestep, theirs).prev_sample
        ours = sampler.step(eps, k, ours, torch.full(SHAPE, torch.nan))
        assert torch.equal(ours, theirs)


def test_chosen_timesteps_equal_diffusers_where_those_are_its_own():
    ours, theirs = Sampler("ddim", timesteps=range(96, -1, -3)), Sampler("ddim", 33)
    assert torch.equal(ours.timesteps, theirs.timesteps)
    sample, eps = torch.randn(2, *SHAPE)
    for k in range(33):
        assert torch.equal(ours.step(eps, k, sample), theirs.step(eps, k, sample))


def test_steps_of_constant_noise_may_be_left_out():
    """A deterministic sampler that is told the same noise everywhere ends in the same place however it gets there."""
    sample, eps = 0.1 * torch.randn(2, *SHAPE)
    ends = []
    for timesteps in ([60, 10], [60, 33, 32, 10]):
        sampler, x = Sampler("ddim", timesteps=timesteps), sample
        for k in range(len(timesteps)):
            x = sampler.step(eps, k, x)
        ends.append(x)
    torch.testing.assert_close(*ends, atol=1e-5, rtol=0)


def test_published_timesteps_run_from_99_to_0():
    assert Sampler().timesteps.tolist() == list(range(99, -1, -1))


@pytest.mark.parametrize(
    "sampler",
    [Sampler("ddpm", 20), Sampler("ddim", 20), Sampler("ddim", timesteps=[80, 75, 20])],
    ids=lambda sampler: sampler.name,
)
def test_the_true_noise_leads_back_to_the_clean_sample(sampler):
    clean = torch.rand(SHAPE) * 2 - 1
    sample = torch.randn(SHAPE)
    alphas = sampler.scheduler.alphas_cumprod
    for k, timestep in enumerate(sampler.timesteps):
        eps = (sample - alphas[timestep].sqrt() * clean) / (1 - alphas[timestep]).sqrt()
        sample = sampler.step(eps, k, sample, torch.randn(SHAPE))
    torch.testing.assert_close(sample, clean, atol=1e-4, rtol=0)


def test_add_noise_mixes_by_the_cumulative_alpha():
    sampler = Sampler()
    clean, noise, timestep = torch.randn(3, 4, 2), torch.randn(3, 4, 2), torch.tensor([0, 50, 99])
    alpha = sampler.scheduler.alphas_cumprod[timestep][:, None, None]
    expected = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise
    torch.testing.assert_close(sampler.add_noise(clean, noise, timestep), expected)


def test_config_rebuilds_the_schedule():
    for sampler in (Sampler("ddim", 7, 50), Sampler("ddim", None, 50, timesteps=[40, 9])):
        by_name = Sampler.from_name(sampler.name, sampler.num_inference_steps, 50)
        for again in (Sampler(**sampler.config), by_name):
            assert repr(again) == repr(sampler)
            assert torch.equal(again.timesteps, sampler.timesteps)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match='kind must be "ddpm" or "ddim", got \'flow\''):
        Sampler("flow")
    with pytest.raises(
        ValueError, match=r"num_inference_steps: expected a whole number from 1 to 100, got 101"
    ):
        Sampler("ddim", 101)
    for kind, steps, timesteps in (
        ("ddim", 2, [5, 5]),
        ("ddim", 2, [1, 9]),
        ("ddim", 1, [100]),
        ("ddim", 1, [-1]),
        ("ddim", 1, [float("inf")]),
        ("ddim", 2, ["9", "5"]),
        ("ddim", 3, [9, 5]),
        ("ddpm", 2, [9, 5]),
    ):
        with pytest.raises(ValueError, match=rf"timesteps: expected {steps} .*got \[.*of kind \"{kind}\""):
            Sampler(kind, steps, timesteps=timesteps)
    with pytest.raises(
        ValueError, match=r"num_inference_steps: expected a whole number from 1 to 100, got 0"
    ):
        Sampler("ddim", timesteps=[])
    for name in ("ddim_", "ddim_-3", "flow", "ddim_9_x", None):
        with pytest.raises(ValueError, match=f"sampler: expected 'ddpm', 'ddim' .*got {name!r}"):
            Sampler.from_name(name, 2)
    sampler, sample = Sampler(), torch.zeros(SHAPE)
    with pytest.raises(ValueError, match=r"k=3 .*needs noise_k"):
        sampler.step(sample, 3, sample)
    with pytest.raises(IndexError, match=r"0\.\.99, got 100"):
        sampler.step(sample, 100, sample)
