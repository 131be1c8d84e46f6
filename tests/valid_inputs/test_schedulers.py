"""Valid checkpoints whose scheduler is another than the published one: honoured as diffusers has it, or refused by name."""

import inspect

import diffusers
import pytest
import torch

from tests.refusals import refused
from tests.storage.published.checkpoints import LowDimPolicy
from tests.valid_inputs.checkpoints import read, scheduled
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.methods.diffusion import make_method
from torchrl_sparse.storage.published.faults import CheckpointError

ENGINES = ["reference", "torch"] + ["native"] * native_available()[0]
DDPM, DDIM = diffusers.DDPMScheduler, diffusers.DDIMScheduler


@pytest.fixture(scope="module")
def made():
    return LowDimPolicy(n_layer=1, n_emb=16)


HONOURED = [
    (DDPM, 100, {}),
    (DDPM, 10, {"timestep_spacing": "trailing"}),
    (DDPM, 7, {"timestep_spacing": "linspace", "clip_sample_range": 1.5}),
    (DDPM, 10, {"steps_offset": 3}),
    (DDPM, 10, {"timestep_spacing": "trailing", "steps_offset": 3}),  # where diffusers does not read it
    (DDPM, 5, {"num_train_timesteps": 50, "clip_sample_range": 0.5}),
    (DDIM, 16, {"set_alpha_to_one": True}),
    (DDIM, 10, {"timestep_spacing": "trailing", "clip_sample_range": 2}),
    (DDIM, 10, {"steps_offset": 1}),
    (DDIM, 100, {"timestep_spacing": "linspace"}),
]


@pytest.mark.parametrize(("kind", "steps", "entries"), HONOURED)
def test_a_scheduler_samples_as_diffusers_does_with_its_entries(tmp_path, made, kind, steps, entries):
    """Each step equals that of the published evaluation, diffusers' scheduler of the checkpoint's own entries."""
    sampler = read(tmp_path, made, scheduled(kind, steps, **entries)).sampler
    theirs = kind(**{"num_train_timesteps": 100, "beta_schedule": "squaredcos_cap_v2"} | entries)
    theirs.set_timesteps(steps)
    assert sampler.timesteps.tolist() == theirs.timesteps.tolist()
    for k, timestep in enumerate(theirs.timesteps):
        sample, eps = 2 * torch.randn(2, 2, 4, 10)
        drawn, handed = (torch.Generator().manual_seed(k) for _ in range(2))
        expected = theirs.step(eps, timestep, sample, generator=drawn).prev_sample
        ours = sampler.step(eps, k, sample, torch.randn(2, 4, 10, generator=handed))
        # Where diffusers ends above timestep 0, it adds noise of 1e-10 to the clean sample.
        torch.testing.assert_close(ours, expected, atol=1e-8, rtol=0)
    assert Sampler(**sampler.config).config == sampler.config


@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_clips_as_the_checkpoint_says(tmp_path, made, engine):
    """A whole policy call equals the published loop over diffusers' scheduler."""
    entries = {"timestep_spacing": "trailing", "clip_sample_range": 0.3}
    policy = read(tmp_path, made, scheduled(DDIM, 10, **entries), engine=engine)
    theirs = DDIM(100, beta_schedule="squaredcos_cap_v2", **entries)
    theirs.set_timesteps(10)
    noise, cond = torch.randn(2, 10, 10, 10), torch.randn(2, 2, 19)
    sample = noise[:, 0]
    for timestep in theirs.timesteps:
        sample = theirs.step(made.model(sample, timestep, cond), timestep, sample).prev_sample
    assert sample.abs().max() > 0.25
    torch.testing.assert_close(policy.denoise(noise, cond), sample, atol=1e-5, rtol=0)


def test_what_a_network_was_trained_with_stays_when_the_sampler_changes(tmp_path, made):
    """A method's few steps have the training steps and the clip range of the policy; another sampler is refused."""
    policy = read(tmp_path, made, scheduled(DDPM, 50, num_train_timesteps=50, clip_sample_range=2.0))
    method = make_method("ddim10", policy, num_updates=10, planners=tmp_path, calibration=dict)
    for sampler in (method.sampler, policy.sampler.last_steps(3)):
        assert (sampler.num_train_timesteps, sampler.clip_sample_range) == (50, 2.0)
        assert sampler.coefficients.clip == 2.0
    with refused("sampler"):
        policy.sampler = Sampler("ddim", 10)
    policy.save_pretrained(tmp_path)
    assert DiffusionPolicy.from_pretrained(tmp_path).sampler.config == policy.sampler.config


@pytest.mark.parametrize("kind", [DDPM, DDIM])
def test_every_entry_that_diffusers_has_may_be_written_out(tmp_path, made, kind):
    """Entries at diffusers' defaults change nothing; one that it does not have is refused by its name."""
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(kind.__init__).parameters.items()
        if name not in ("self", "beta_schedule")
    }
    sampler = read(tmp_path, made, scheduled(kind, 20, **defaults)).sampler
    assert sampler.config == {
        "kind": kind.__name__[:4].lower(),
        "num_inference_steps": 20,
        "num_train_timesteps": 1000,
    }
    with refused("latest.ckpt: cfg: policy.noise_scheduler.churn", CheckpointError):
        read(tmp_path, made, scheduled(kind, 20, churn=1))


REFUSED = [
    (DDPM, 10, {"trained_betas": [0.1] * 100}, "ckpt: cfg: policy.noise_scheduler.trained_betas"),
    (
        DDPM,
        10,
        {"clip_sample": None},
        "ckpt: cfg: policy.noise_scheduler.clip_sample",
    ),  # to diffusers, null is false
    (DDPM, 10, {"thresholding": True}, "ckpt: cfg: policy.noise_scheduler.thresholding"),
    (DDPM, 10, {"rescale_betas_zero_snr": True}, "policy.noise_scheduler.rescale_betas_zero_snr"),
    (DDPM, 10, {"variance_type": "fixed_small_log"}, "ckpt: cfg: policy.noise_scheduler.variance_type"),
    (DDPM, 10, {"variance_type": "fixed_large"}, "ckpt: cfg: policy.noise_scheduler.variance_type"),
    (DDPM, 100, {"steps_offset": 1}, "policy.noise_scheduler.steps_offset: timesteps"),
    (DDPM, 10, {"_target_": "mine.schedulers.DDPMScheduler"}, "ckpt: cfg: policy.noise_scheduler._target_"),
    (DDIM, 10, {"set_alpha_to_one": False}, "cfg: policy.noise_scheduler.set_alpha_to_one"),
    # diffusers' DDIM leads T // K down and asks elsewhere: no chain of timesteps
    (DDIM, 10, {"timestep_spacing": "linspace"}, "cfg: policy.noise_scheduler.timestep_spacing"),
    (DDIM, 7, {"timestep_spacing": "trailing"}, "cfg: policy.noise_scheduler.timestep_spacing"),
    (DDIM, 16, {"steps_offset": 8}, "cfg: policy.noise_scheduler.timestep_spacing"),
]


@pytest.mark.parametrize(("kind", "steps", "entries", "message"), REFUSED)
def test_what_no_sampler_here_does_is_refused(tmp_path, made, kind, steps, entries, message):
    """An entry of diffusers that is not supported is named."""
    with refused(message, CheckpointError):
        read(tmp_path, made, scheduled(kind, steps, **entries))
