"""Denoising steps against diffusers' own, with the noise handed in."""

from dataclasses import replace

import pytest
import torch
from diffusers import (
    DDIMScheduler,
    DDPMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)

from torchrl_sparse.networks.diffusion.sampler import Sampler

TRAINED = {"num_train_timesteps": 100, "beta_schedule": "squaredcos_cap_v2", "prediction_type": "epsilon"}
PUBLISHED = TRAINED | {"clip_sample": True}
SHAPE = (2, 10, 10)


def run(sampler, predict, noise):
    """The sample after every step; `predict(sample, timestep)` is the network."""
    sample, cleans, samples = noise[0], (), []
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        eps = predict(sample, timestep)
        after = sampler.step(eps, k, sample, noise[k + 1], cleans)
        cleans = sampler.remember(cleans, eps, k, sample)
        sample = after
        samples.append(sample)
    return torch.stack(samples)


@pytest.mark.parametrize("steps", [1, 2, 50, 100, 1000, 10_000])
def test_the_schedule_of_noise_is_that_of_diffusers(steps):
    ours = Sampler(num_train_timesteps=steps).alphas_cumprod
    assert torch.equal(ours, DDPMScheduler(steps, beta_schedule="squaredcos_cap_v2").alphas_cumprod)


@pytest.mark.parametrize(("steps", "spacing"), [(100, "leading"), (25, "leading"), (16, "leading"), (10, "trailing"),
                                                (7, "trailing"), (10, "linspace"), (1, "leading")])  # fmt: skip
def test_ddpm_equals_diffusers_with_its_variance_noise(steps, spacing):
    sampler = Sampler("ddpm", steps, spacing=spacing)
    reference = DDPMScheduler(variance_type="fixed_small", timestep_spacing=spacing, **PUBLISHED)
    reference.set_timesteps(steps)
    check_ddpm(sampler, reference)


@pytest.mark.parametrize("timesteps", [[82, 14], [99, 98, 41, 40, 0], [91, 58, 24, 0]])
def test_ddpm_at_any_timesteps_equals_diffusers(timesteps):
    reference = DDPMScheduler(variance_type="fixed_small", **PUBLISHED)
    reference.set_timesteps(timesteps=timesteps)
    check_ddpm(Sampler("ddpm", timesteps=timesteps), reference)


def check_ddpm(sampler, reference):
    assert torch.equal(sampler.timesteps, reference.timesteps)
    drawn, handed = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    ours = theirs = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    for k, timestep in enumerate(reference.timesteps):
        eps = torch.randn(SHAPE, generator=torch.Generator().manual_seed(100 + k))
        theirs = reference.step(eps, timestep, theirs, generator=drawn).prev_sample
        noise = torch.randn(SHAPE, generator=handed) if sampler.coefficients.reads_noise(k) else None
        ours = sampler.step(eps, k, ours, noise)
        # Where diffusers ends above timestep 0, it adds noise of 1e-10 to the clean sample.
        tolerance = 0 if timestep == 0 or k + 1 < len(reference.timesteps) else 1e-8
        torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=0)


@pytest.mark.parametrize("eta", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("steps", [100, 33, 10, 7, 1])
def test_ddim_equals_diffusers(steps, eta):
    sampler = Sampler("ddim", steps, eta=eta)
    reference = DDIMScheduler(**PUBLISHED)
    reference.set_timesteps(steps)
    assert torch.equal(sampler.timesteps, reference.timesteps)
    ours = theirs = torch.randn(SHAPE)
    for k, timestep in enumerate(reference.timesteps):
        eps, noise = torch.randn(2, *SHAPE)
        theirs = reference.step(eps, timestep, theirs, eta=eta, variance_noise=noise).prev_sample
        read = noise if sampler.coefficients.reads_noise(k) else torch.full(SHAPE, torch.nan)
        ours = sampler.step(eps, k, ours, read)
        assert torch.equal(ours, theirs)
    assert sampler.coefficients.reads_noise(0) == (eta > 0 and steps > 1)


SOLVERS = {
    "dpmpp2m": (DPMSolverMultistepScheduler, {"algorithm_type": "dpmsolver++"}),
    "sde2m": (DPMSolverMultistepScheduler, {"algorithm_type": "sde-dpmsolver++"}),
    "unipc": (UniPCMultistepScheduler, {"solver_type": "bh2"}),
}


@pytest.mark.parametrize("spacing", ["leading", "trailing", "linspace"])
@pytest.mark.parametrize("steps", [1, 2, 3, 4, 10, 20, 33])
@pytest.mark.parametrize("kind", SOLVERS)
def test_solvers_equal_diffusers_where_nothing_is_clipped(kind, steps, spacing):
    scheduler, options = SOLVERS[kind]
    reference = scheduler(timestep_spacing=spacing, solver_order=2, **options, **TRAINED)
    reference.set_timesteps(steps)
    sampler = Sampler(kind, steps, spacing=spacing)
    assert torch.equal(sampler.timesteps, reference.timesteps)
    coefficients, abar = replace(sampler.coefficients, clip=1e6), sampler.alphas_cumprod
    generator = torch.Generator().manual_seed(0)
    sample, target = torch.randn(2, *SHAPE, generator=generator)
    cleans = ()
    for k, timestep in enumerate(reference.timesteps):
        clean = target + 0.3 * torch.sin(sample + timestep)
        eps = (sample - abar[timestep].sqrt() * clean) / (1 - abar[timestep]).sqrt()
        noise = torch.randn(SHAPE, generator=generator)
        extra = {"variance_noise": noise} if kind == "sde2m" else {}
        ours = coefficients.update(k, sample, eps, noise, cleans)
        theirs = reference.step(eps, timestep, sample, **extra).prev_sample
        # Where abar is 1e-9, f32 leaves a clean prediction no more digits.
        tolerance = 1e-6 if timestep < 98 else 1e-3
        torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=tolerance)
        cleans = [output for output in reversed(reference.model_outputs) if output is not None]
        sample = theirs


def test_the_rule_is_diffusers_trailing_below_a_smallest_log_ratio():
    reference = DPMSolverMultistepScheduler(timestep_spacing="trailing", lambda_min_clipped=-2.1, **TRAINED)
    for kind in ("ddpm", "ddim", "dpmpp2m"):
        for steps in range(1, 12):
            reference.set_timesteps(steps)
            assert torch.equal(Sampler(kind, steps, spacing="logsnr").timesteps, reference.timesteps)
    assert Sampler("ddpm", 2, spacing="logsnr").timesteps.tolist() == [91, 41]
    assert Sampler("ddpm", 3, spacing="logsnr").timesteps.tolist() == [91, 58, 24]


@pytest.mark.parametrize("spacing", ["leading", "trailing", "linspace"])
def test_every_spacing_is_that_of_diffusers(spacing):
    """Its "trailing" rounds to one timestep more, -1, for some numbers of steps."""
    for steps in range(1, 101):
        for scheduler in (DDPMScheduler, DDIMScheduler):
            reference = scheduler(timestep_spacing=spacing, **PUBLISHED)
            reference.set_timesteps(steps)
            assert (
                Sampler("ddim", steps, spacing=spacing).timesteps.tolist()
                == reference.timesteps[:steps].tolist()
            )


def test_in_two_steps_the_solvers_are_samplers_that_exist_already():
    """First and last step are of first order: DDPM's; and there is nothing to correct."""
    noise = torch.randn(3, *SHAPE)

    def predict(sample, timestep):
        return torch.cos(3 * sample + timestep)

    def end(kind):
        return run(Sampler(kind, timesteps=[80, 14]), predict, noise)[-1]

    torch.testing.assert_close(end("sde2m"), end("ddpm"), atol=1e-6, rtol=0)
    torch.testing.assert_close(end("unipc"), end("dpmpp2m"), atol=1e-6, rtol=0)
    assert (end("ddim") - end("dpmpp2m")).abs().max() > 1e-2  # where something is clipped


def test_predictions_are_clipped_and_solvers_remember_them_so():
    sampler, eps, sample = Sampler("unipc", 5), torch.full(SHAPE, 9.0), torch.zeros(SHAPE)
    cleans = ()
    for k in range(5):
        cleans = sampler.remember(cleans, eps, k, sample)
        assert [clean.unique().tolist() for clean in cleans] == [[-1.0]] * min(k + 1, 2)


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


CHAINS = [
    Sampler("ddpm", 20),
    Sampler("ddpm", timesteps=[80, 75, 20]),
    Sampler("ddim", 20, spacing="trailing"),
    Sampler("ddim", timesteps=[80, 75, 20], eta=0.7),
    Sampler("dpmpp2m", 6),
    Sampler("sde2m", 5, spacing="logsnr"),
    Sampler("unipc", timesteps=[80, 75, 20, 2]),
]


@pytest.mark.parametrize("sampler", CHAINS, ids=lambda sampler: sampler.name)
def test_the_true_noise_leads_back_to_the_clean_sample(sampler):
    clean, abar = torch.rand(SHAPE) * 2 - 1, sampler.alphas_cumprod
    noise = torch.randn(sampler.num_inference_steps + 1, *SHAPE)

    def predict(sample, timestep):
        return (sample - abar[timestep].sqrt() * clean) / (1 - abar[timestep]).sqrt()

    torch.testing.assert_close(run(sampler, predict, noise)[-1], clean, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "sampler", [chain for chain in CHAINS if not chain.coefficients.history], ids=lambda sampler: sampler.name
)
def test_stochastic_steps_keep_the_spread_of_the_forward_process(sampler):
    """Given the clean sample, every sampler leads from N(sqrt(abar_s) clean, 1 - abar_s) to the same at t."""
    at, abar = sampler.coefficients, sampler.alphas_cumprod
    for k, (timestep, after) in enumerate(
        zip(sampler.timesteps.tolist(), sampler.previous_timesteps, strict=True)
    ):
        weight = at.sample_weight[k] + at.eps_weight[k] / (1 - abar[timestep]).sqrt()
        variance = weight**2 * (1 - abar[timestep]) + at.spread[k] ** 2
        expected = 1 - abar[after] if after >= 0 else 0.0
        assert variance.item() == pytest.approx(float(expected), abs=1e-5)


def test_add_noise_mixes_by_the_cumulative_alpha():
    clean, noise, timestep = torch.randn(3, 4, 2), torch.randn(3, 4, 2), torch.tensor([0, 50, 99])
    for kind in ("ddpm", "unipc"):
        expected = DDPMScheduler(**PUBLISHED).add_noise(clean, noise, timestep)
        assert torch.equal(Sampler(kind, 10).add_noise(clean, noise, timestep), expected)


def test_little_noise_is_added_in_bfloat16_too():
    """Right to the rounding of a factor, where diffusers adds none (findings/diffusers_add_noise_bf16.sh)."""
    clean, noise = torch.zeros(8, 1, 1), torch.ones(8, 1, 1)
    exact = Sampler().add_noise(clean, noise, torch.arange(8))
    rounded = Sampler().add_noise(clean.bfloat16(), noise.bfloat16(), torch.arange(8))
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), exact, rtol=2**-8, atol=0)


@pytest.mark.parametrize(
    ("steps", "first", "amplitude"), [(2, 50, "0.69"), (34, 66, "0.49"), (60, 59, "0.58")]
)
def test_steps_that_begin_far_from_noise_are_said(steps, first, amplitude):
    """They begin where diffusers begins (findings/diffusers_leading_spacing_starts_late.sh)."""
    with pytest.warns(
        UserWarning,
        match=rf"^num_inference_steps={steps}: 'leading' begins at timestep {first} of 100, .* {amplitude} ",
    ):
        sampler = Sampler("ddim", steps)
    assert sampler.timesteps[0] == first


@pytest.mark.parametrize("options", [{}, {"num_inference_steps": 10}, {"num_inference_steps": 33},
                                     {"num_inference_steps": 50}, {"num_inference_steps": 60, "spacing": "trailing"},
                                     {"num_inference_steps": 2, "spacing": "logsnr"}, {"timesteps": [50, 0]}])  # fmt: skip
def test_steps_that_begin_near_noise_or_were_chosen_are_not(options, recwarn):
    Sampler("ddim", **options)
    assert not recwarn


def test_ddim_of_eta_one_is_ddpm_until_a_prediction_is_clipped():
    """As diffusers has it (findings/diffusers_ddim_eta_one_is_not_ddpm.sh)."""
    noise, draws = torch.randn(2, *SHAPE), torch.randn(10, *SHAPE)

    def sample(kind, clip, **options):
        sampler, found = Sampler(kind, 10, clip_sample_range=clip, **options), noise[0]
        for k, draw in enumerate(draws):
            found = sampler.step(torch.tanh(found + k), k, found, draw)
        return found

    torch.testing.assert_close(sample("ddim", 1e6, eta=1), sample("ddpm", 1e6), atol=1e-3, rtol=1e-4)
    assert (sample("ddim", 1, eta=1) - sample("ddpm", 1)).abs().max() > 0.1


@pytest.mark.parametrize("kind", ["ddpm", "ddim", "dpmpp2m", "sde2m", "unipc"])
def test_a_last_step_adds_no_noise_wherever_it_begins(kind):
    """diffusers' large variance adds some above timestep 0 (findings/diffusers_large_variance_noises_the_answer.sh)."""
    sampler = Sampler(kind, timesteps=[91, 51, 11], **({"eta": 1.0} if kind == "ddim" else {}))
    sample, eps, clean = torch.randn(3, *SHAPE)
    found = sampler.step(eps, 2, sample, torch.full(SHAPE, torch.nan), (clean, clean))
    assert found.isfinite().all()
    assert found.abs().max() <= 1
