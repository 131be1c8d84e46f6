"""Valid checkpoints in Diffusion Policy's layout whose configuration says something else than the published ones."""

import diffusers
import pytest
import torch
from omegaconf import OmegaConf

from tests.refusals import refused
from tests.storage.published.checkpoints import LowDimPolicy, low_dim_config, put_config
from tests.storage.published.image_checkpoints import ImagePolicy, image_config
from tests.valid_inputs.checkpoints import read
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.storage.published.faults import CheckpointError

ENGINES = ["reference", "torch"] + ["native"] * native_available()[0]
DDPM, DDIM = diffusers.DDPMScheduler, diffusers.DDIMScheduler


@pytest.fixture(scope="module")
def made():
    return LowDimPolicy(n_layer=1, n_emb=16)


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
        with refused("policy"):
            diffusion_env(played, policy)
    else:
        assert diffusion_env(plays, policy)


def test_a_robosuite_policy_of_relative_actions_is_named_so(tmp_path, made):
    """The task is played in poses; ten numbers that the configuration calls relative are none."""
    policy = read(tmp_path, made, put("task.abs_action", False))
    with refused("policy"):
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

    with refused("latest.ckpt: state_dicts: ema_model", CheckpointError):
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
    with refused("latest.ckpt: cfg: policy.obs_encoder_group_norm", CheckpointError):
        read(tmp_path, ImagePolicy(), put("policy.obs_encoder_group_norm", False), make_config=image_config)
