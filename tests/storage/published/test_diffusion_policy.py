"""Published low-dim checkpoints: the same arithmetic, the right weights, and every planner on top."""

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_sparse import BAC, DiffusionPolicy, Sampler, Uniform, keys
from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import calibrate
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.policies.diffusion.convert import main as convert

from .checkpoints import LowDimPolicy, write_checkpoint

ENGINES = ["reference", "torch"] + ["native"] * native_available()[0]


def observations(*batch, policy):
    sizes = policy.sizes
    generator = torch.Generator().manual_seed(1)
    state = torch.randn(*batch, sizes["n_obs_steps"], sizes["obs_dim"], generator=generator)
    td = TensorDict({keys.HISTORY_STATE: state}, batch)
    td[keys.EPISODE_SEED] = torch.arange(td.numel()).reshape(*batch, 1)
    td[keys.EPISODE_STEP] = torch.zeros(*batch, 1, dtype=torch.int64)
    return td


@pytest.mark.parametrize(
    "sizes",
    [
        {"n_layer": 8, "n_emb": 256},  # as published for Lift
        {"obs_dim": 60, "action_dim": 9, "horizon": 16, "n_obs_steps": 4, "n_head": 2},
        {"obs_dim": 16, "action_dim": 2, "horizon": 5, "n_obs_steps": 3},
    ],
)
def test_predicted_noise_is_that_of_the_published_module(tmp_path, sizes):
    published = LowDimPolicy(**sizes)
    policy = DiffusionPolicy.from_diffusion_policy(write_checkpoint(tmp_path / "a.ckpt", published))
    td = observations(4, policy=published)
    cond = published.cond(td[keys.HISTORY_STATE])
    assert torch.equal(policy.module["encode"](td)[keys.COND], cond)
    # In float64: in float32, how a CPU sums up differs by ten times more than any fault that matters.
    model, network, cond = published.model.double(), policy.network.double(), cond.double()
    sample = torch.randn(4, policy.horizon, network.input_dim, dtype=torch.float64)
    for timestep in (0, 37, 99):
        expected = model(sample, timestep, cond)
        assert expected.abs().mean() > 0.1
        with torch.no_grad():
            difference = network(sample, timestep, cond) - expected
        assert difference.abs().max() <= 1e-12


@pytest.mark.parametrize("engine", ENGINES)
def test_a_chain_of_100_steps_is_the_published_one(published, checkpoint, engine):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint, engine=engine)
    td = policy(observations(2, policy=published))
    noise = policy.sample_noise(td[keys.SEED].squeeze(-1))
    expected = published.chain(noise, published.cond(td[keys.HISTORY_STATE]))
    chunk = policy.normalizer.normalize_action(td[keys.CHUNK])
    assert (chunk - expected[:, 1:]).abs().max() <= 1e-5
    torch.testing.assert_close(td[keys.CHUNK], published.unnormalize(expected)[:, 1:], atol=2e-5, rtol=0)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("method", ["uniform", "bac", "ddim"])
def test_every_planner_runs_on_an_imported_policy(published, checkpoint, engine, method):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint, engine=engine)
    if method == "uniform":
        policy.plan = Uniform(10)
    elif method == "ddim":
        policy.sampler = Sampler("ddim", 10)
    else:
        noise = policy.sample_noise(torch.tensor([1]))
        calibration = calibrate(policy.network, policy.sampler, noise, torch.zeros(1, 2, 19))
        policy.plan = BAC(bac_schedule(calibration, 10, policy=policy.fingerprint))
    td = policy(observations(3, policy=published))
    assert td[keys.CHUNK].shape == (3, 9, 10)
    assert td[keys.CHUNK].isfinite().all()
    assert td[keys.PRUNE_MASK].any() == (method != "ddim")


def test_averaged_weights_are_preferred_and_raw_ones_taken_where_there_are_no_others(published, tmp_path):
    averaged = DiffusionPolicy.from_diffusion_policy(write_checkpoint(tmp_path / "a.ckpt", published))
    assert averaged.source["weights"] == "ema_model"
    bias = published.model.head.bias
    assert torch.equal(averaged.network.head.bias, bias)

    def without_average(payload):
        del payload["state_dicts"]["ema_model"]
        payload["cfg"].training.use_ema = False

    raw = write_checkpoint(tmp_path / "b.ckpt", published, change=without_average)
    raw = DiffusionPolicy.from_diffusion_policy(raw)
    assert raw.source["weights"] == "model"
    assert torch.equal(raw.network.head.bias, bias + 0.1)


def test_source_says_how_to_feed_the_policy(checkpoint):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint)
    assert policy.source == {
        "weights": "ema_model",
        "task": "lift_lowdim",
        "epoch": 650,
        "n_action_steps": 8,
        "abs_action": True,
        "robosuite": None,
        "state_keys": ["object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"],
    }
    assert policy.sampler.config == {"kind": "ddpm", "num_inference_steps": 100, "num_train_timesteps": 100}
    assert policy.network.config["p_drop_attn"] == 0.3


def test_ddim_sampler_of_the_configuration(published, tmp_path):
    def change(payload):
        scheduler = payload["cfg"].policy.noise_scheduler
        scheduler._target_ = "diffusers.schedulers.scheduling_ddim.DDIMScheduler"
        scheduler.update({"set_alpha_to_one": True, "steps_offset": 0})
        payload["cfg"].policy.num_inference_steps = 16

    policy = DiffusionPolicy.from_diffusion_policy(
        write_checkpoint(tmp_path / "a.ckpt", published, change=change)
    )
    assert policy.sampler.config == {"kind": "ddim", "num_inference_steps": 16, "num_train_timesteps": 100}


def test_a_normaliser_with_one_number_for_all_dimensions(published, tmp_path):
    def change(payload):
        state = payload["state_dicts"]["ema_model"]
        state["normalizer.params_dict.obs.scale"] = torch.tensor([0.25])
        state["normalizer.params_dict.obs.offset"] = torch.tensor([0.5])

    policy = DiffusionPolicy.from_diffusion_policy(
        write_checkpoint(tmp_path / "a.ckpt", published, change=change)
    )
    assert torch.equal(policy.normalizer.normalize_state(torch.ones(19)), torch.full((19,), 0.75))


def test_the_command_converts(published, checkpoint, tmp_path, capsys):
    assert convert([str(checkpoint), str(tmp_path / "full")]) == 0
    assert "task lift_lowdim" in capsys.readouterr().out
    imported = DiffusionPolicy.from_diffusion_policy(checkpoint)
    converted = DiffusionPolicy.from_pretrained(tmp_path / "full")
    td = observations(2, policy=published)
    assert torch.equal(converted(td.clone())[keys.CHUNK], imported(td.clone())[keys.CHUNK])
    assert converted.source == imported.source
    assert convert([str(checkpoint), str(tmp_path / "half"), "--half"]) == 0
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("full", "half")]
    assert sizes[1] < 0.6 * sizes[0]
    assert DiffusionPolicy.from_pretrained(tmp_path / "half").fingerprint == converted.fingerprint


def test_the_command_names_what_is_wrong(tmp_path, capsys):
    (tmp_path / "a.ckpt").write_bytes(b"nothing")
    assert convert([str(tmp_path / "a.ckpt"), str(tmp_path / "out")]) == 1
    assert "a.ckpt: expected a complete zip archive" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["env_meta", "task.env_meta", "task.env_runner.env_meta"])
def test_the_version_of_robosuite_is_read_where_it_is_noted(published, tmp_path, place):
    def note(payload):
        OmegaConf.update(payload["cfg"], place, {"env_name": "Lift", "env_version": "1.4.1"})

    path = write_checkpoint(tmp_path / "a.ckpt", published, change=note)
    assert DiffusionPolicy.from_pretrained(path).source["robosuite"] == "1.4.1"


def test_the_version_of_robosuite_may_stand_beside_the_weights(published, tmp_path):
    def note(payload):
        payload["env_meta"] = {"env_name": "Lift", "env_version": "1.4.1"}

    path = write_checkpoint(tmp_path / "a.ckpt", published, change=note)
    assert DiffusionPolicy.from_pretrained(path).source["robosuite"] == "1.4.1"
