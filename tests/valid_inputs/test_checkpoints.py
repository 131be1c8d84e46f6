"""Valid checkpoints in Diffusion Policy's layout whose configuration says something else than the published ones."""

import inspect

import diffusers
import pytest
import torch
from omegaconf import OmegaConf

from tests.storage.published.checkpoints import LowDimPolicy, low_dim_config, put_config, write_checkpoint
from tests.storage.published.image_checkpoints import ImagePolicy, image_config
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.methods.diffusion import make_method
from torchrl_sparse.storage.published.faults import CheckpointError

ENGINES = ["reference", "torch"] + ["native"] * native_available()[0]
DDPM, DDIM = diffusers.DDPMScheduler, diffusers.DDIMScheduler


@pytest.fixture(scope="module")
def made():
    return LowDimPolicy(n_layer=1, n_emb=16)


def read(folder, made, *changes, make_config=low_dim_config, **options):
    """The policy of a checkpoint whose payload was changed."""

    def change(payload):
        for one in changes:
            one(payload)

    path = write_checkpoint(folder / "latest.ckpt", made, change=change, make_config=make_config)
    return DiffusionPolicy.from_diffusion_policy(path, **options)


def scheduled(kind, steps, **entries):
    """A change: the scheduler is diffusers' ``kind`` with these entries, in that many steps."""

    def change(payload):
        scheduler = {
            "_target_": f"diffusers.{kind.__name__}",
            "beta_schedule": "squaredcos_cap_v2",
            **entries,
        }
        payload["cfg"].policy.noise_scheduler = {"num_train_timesteps": 100} | scheduler
        payload["cfg"].policy.num_inference_steps = steps

    return change


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
    """A whole query equals the published loop over diffusers' scheduler."""
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
    with pytest.raises(
        ValueError, match=r"sampler: expected .*50.*2\.0.*, with which the policy was trained"
    ):
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
    with pytest.raises(CheckpointError, match=r"noise_scheduler\.churn: expected no entry of this name"):
        read(tmp_path, made, scheduled(kind, 20, churn=1))


REFUSED = [
    (DDPM, 10, {"trained_betas": [0.1] * 100}, "trained_betas: expected null"),
    (
        DDPM,
        10,
        {"clip_sample": None},
        "clip_sample: expected a value, got null",
    ),  # to diffusers, null is false
    (DDPM, 10, {"thresholding": True}, "thresholding: expected false"),
    (DDPM, 10, {"rescale_betas_zero_snr": True}, "rescale_betas_zero_snr: expected false"),
    (DDPM, 10, {"variance_type": "fixed_small_log"}, "variance_type: expected 'fixed_small'"),
    (DDPM, 100, {"steps_offset": 1}, "steps_offset: timesteps: expected 100"),
    (DDPM, 10, {"_target_": "mine.schedulers.DDPMScheduler"}, "expected diffusers' DDPMScheduler or DDIM"),
    (DDIM, 10, {"set_alpha_to_one": False}, "set_alpha_to_one: expected true, got false"),
    # diffusers' DDIM leads T // K down and asks elsewhere: no chain of timesteps
    (DDIM, 10, {"timestep_spacing": "linspace"}, "timestep_spacing: expected timesteps 10 apart"),
    (DDIM, 7, {"timestep_spacing": "trailing"}, "timestep_spacing: expected timesteps 14 apart"),
    (DDIM, 16, {"steps_offset": 8}, "got 'leading' with steps_offset 8 in 16 steps"),
]


@pytest.mark.parametrize(("kind", "steps", "entries", "message"), REFUSED)
def test_what_no_sampler_here_does_is_refused(tmp_path, made, kind, steps, entries, message):
    """An entry of diffusers that is not supported is named."""
    with pytest.raises(CheckpointError, match=message):
        read(tmp_path, made, scheduled(kind, steps, **entries))


def put(path, value):
    def change(payload):
        OmegaConf.update(payload["cfg"], path, value, force_add=True)

    return change


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("n_latency_steps", 2, "expected 0, got 2"),
        ("task.env_runner.n_latency_steps", 1, "expected 0, got 1"),
        ("past_action_visible", True, "expected false, got true"),
        ("keypoint_visible_rate", 0.5, r"expected 1\.0, got 0\.5"),
        ("policy.use_clipped_model_output", True, "expected false, got true"),
        ("policy.obs_as_cond", False, "expected true, got false"),
        ("policy.eta", 0.5, "expected none of DDPM"),
        ("policy.guidance", 2.0, "expected no entry of this name"),
        ("policy.n_action_steps", 4, "expected 8, as n_action_steps, got 4"),
        ("policy.model.n_layer", 3, "is 3, the tensors say 1"),
        ("policy.model.rope", True, "expected no entry of this name"),
        ("policy.model._target_", "mine.Mamba", "expected TransformerForDiffusion, got mine.Mamba"),
        ("obs_dim", 20, "is 20, the tensors say 19"),
        ("action_dim", 7, "is 7, the tensors say 10"),
        ("task.obs_eef_target", False, "expected true, got false"),
        ("task.env_runner.agent_keypoints", True, "expected false, got true"),
        ("task.env_runner.abs_action", False, "expected true, as task.abs_action, got false"),
        ("task.env_runner.obs_keys", ["object"], r"expected \['object', 'robot0_eef_pos'"),
        ("task.dataset.rotation_rep", "axis_angle", "expected 'rotation_6d', got 'axis_angle'"),
        ("task.dataset.delta_action", True, "expected false, got true"),
        ("task.pose_repr", {"obs": "relative"}, "expected no entry of this name"),
    ],
)
def test_an_entry_that_is_not_read_has_to_be_the_default(tmp_path, made, entry, value, message):
    """What changes the policy, its observations or its actions is refused by name."""
    with pytest.raises(CheckpointError, match=f"{entry}.*{message}"):
        read(tmp_path, made, put(entry, value))


def test_an_unknown_entry_may_be_ignored(tmp_path, made):
    """Who knows that a policy does not depend on an entry may say so."""
    policy = read(tmp_path, made, put("task.dataset.note", 1), ignore=["task.dataset.note"])
    assert policy.source["task"] == "lift_lowdim"


RUNNER = {
    "n_train": 6,
    "n_train_vis": 2,
    "n_test": 50,
    "n_test_vis": 4,
    "test_start_seed": 100000,
    "n_envs": None,
}
RUNNER |= {
    "n_obs_steps": "${n_obs_steps}",
    "n_action_steps": "${n_action_steps}",
    "fps": 10,
    "max_steps": 300,
}
DATASET = {
    "horizon": "${horizon}",
    "pad_before": "${eval:'${n_obs_steps}-1'}",
    "pad_after": 7,
    "seed": 42,
    "val_ratio": 0.02,
}


def of_task(name, obs_dim, action_dim, task, runner, dataset):
    made = LowDimPolicy(obs_dim=obs_dim, action_dim=action_dim, n_layer=1, n_emb=16)

    def config(policy):
        written = low_dim_config(policy)
        written.task = {"name": name, "obs_dim": obs_dim, "action_dim": action_dim, "keypoint_dim": 2, **task}
        written.task.update({"env_runner": RUNNER | runner, "dataset": DATASET | dataset})
        return written

    return made, config


BLOCKS = (
    {"obs_eef_target": "${task.obs_eef_target}"},
    {"zarr_path": "push.zarr", "use_manual_normalizer": False},
)
KITCHEN = {"render_hw": [240, 360], "dataset_dir": "data/kitchen"}, {"dataset_dir": "data/kitchen"}
PUBLISHED = {  # what published configurations say of a task, and who plays it
    "blockpush_lowdim_seed": (
        16,
        2,
        {"obs_eef_target": True},
        {"abs_action": False} | BLOCKS[0],
        BLOCKS[1],
        "block_push",
    ),
    "blockpush_lowdim_seed_abs": (
        16,
        2,
        {"obs_eef_target": True},
        {"abs_action": True} | BLOCKS[0],
        BLOCKS[1],
        None,
    ),
    "kitchen_lowdim": (60, 9, {}, *KITCHEN, None),
    "kitchen_lowdim_abs": (
        *(60, 9, {"abs_action": True, "robot_noise_ratio": 0.1}),
        *({"abs_action": "${task.abs_action}", "robot_noise_ratio": 0.1} | KITCHEN[0], KITCHEN[1], "kitchen"),
    ),
    "pusht_lowdim": (
        *(20, 2, {}, {"keypoint_visible_rate": 1.0, "agent_keypoints": False, "legacy_test": True}),
        *({"zarr_path": "pusht.zarr", "max_train_episodes": 90}, "pusht"),
    ),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_actions_of_the_other_kind_are_not_played(tmp_path, name):
    """Published policies of one task and size say where to go, or how far, and only their configuration tells which."""
    obs_dim, action_dim, task, runner, dataset, plays = PUBLISHED[name]
    made, config = of_task(name, obs_dim, action_dim, task, runner, dataset)
    policy = read(tmp_path, made, make_config=config)
    policy.source["task"] = None  # its name may be anybody's
    played = {(16, 2): "block_push", (60, 9): "kitchen", (20, 2): "pusht"}[obs_dim, action_dim]
    if plays is None:
        with pytest.raises(
            ValueError, match=r"policy: expected one of (absolute|relative) actions .*, got one of"
        ):
            diffusion_env(played, policy)
    else:
        assert diffusion_env(plays, policy)


def test_a_robosuite_policy_of_relative_actions_is_named_so(tmp_path, made):
    """The task is played in poses; ten numbers that the configuration calls relative are none."""
    policy = read(tmp_path, made, put("task.abs_action", False))
    with pytest.raises(
        ValueError, match=r"absolute actions \(abs_action true\) for Lift, got one of relative"
    ):
        diffusion_env("lift", policy)


WRAPPED = {
    "DDP": lambda key: f"module.{key}",
    "compiled": lambda key: f"_orig_mod.{key}",
    "network compiled": lambda key: key.replace("model.", "model._orig_mod.", 1),
    "both": lambda key: f"module._orig_mod.{key}",
    "layers checkpointed": lambda key: key.replace("layers.0.", "layers.0._checkpoint_wrapped_module."),
}


@pytest.mark.parametrize("wrapper", WRAPPED)
def test_weights_that_were_saved_from_a_wrapper_are_the_same_weights(tmp_path, made, wrapper):
    """PyTorch's wrappers add a word to names and change nothing else."""

    def rename(payload):
        states = payload["state_dicts"]
        states["ema_model"] = {WRAPPED[wrapper](key): value for key, value in states["ema_model"].items()}

    policy = read(tmp_path, made, rename)
    assert torch.equal(policy.network.head.weight, made.model.head.weight)


def test_two_names_of_one_tensor_are_refused(tmp_path, made):
    """A state dict with wrapped and plain names says two things."""

    def double(payload):
        state = payload["state_dicts"]["ema_model"]
        state["model.module.head.weight"] = state["model.head.weight"] + 1

    with pytest.raises(CheckpointError, match=r"ema_model: expected one tensor model\.head\.weight"):
        read(tmp_path, made, double)


def test_use_ema_says_which_weights(tmp_path, made):
    """The published evaluation takes the averaged weights exactly if ``training.use_ema`` is true."""
    raw = read(tmp_path, made, put_config("training.use_ema", False))
    assert raw.source["weights"] == "model"
    assert torch.equal(raw.network.head.bias, made.model.head.bias + 0.1)


@pytest.mark.parametrize(
    ("said", "crop"), [({}, (76, 76)), ({"crop_shape": None}, (84, 84)), ({"crop_shape": [70, 72]}, (70, 72))]
)
def test_a_crop_that_is_not_written_is_the_published_default(tmp_path, said, crop):
    """``DiffusionTransformerHybridImagePolicy`` crops to 76 pixels where nothing is said, and not at all where null is."""

    def config(policy):
        written = image_config(policy)
        del written.policy["crop_shape"]
        written.policy.update(said)
        return written

    policy = read(tmp_path, ImagePolicy(), make_config=config)
    assert tuple(policy.vision.config["crop_size"]) == crop


def test_batch_norms_of_an_image_policy_are_named(tmp_path):
    """Without ``obs_encoder_group_norm`` the published encoder has batch norms, which this one has not."""
    with pytest.raises(CheckpointError, match="obs_encoder_group_norm: expected true, got false"):
        read(tmp_path, ImagePolicy(), put("policy.obs_encoder_group_norm", False), make_config=image_config)
