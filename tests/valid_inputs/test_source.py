"""A policy's ``source`` is its contract: one function under two conventions gives the same number wherever data meet it."""

import json
from dataclasses import replace
from functools import partial

import h5py
import hydra
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recipes.studies.carried_noise.chains import carried_noise
from recipes.studies.offline_errors.errors import draw_answers, offline_errors
from recipes.studies.search_schedule.schedules import Judge
from tests.data.published_demos import env_args_14, env_args_15
from tests.evaluation.accelerate.small import GRID, ask, fixed_times
from tests.recipe_modules import RECIPES, load_recipe
from tests.refusals import refused
from tests.training.runs import train_unbroken
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, TransformerForDiffusion, keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.data.for_policy import contract_demos, policy_demos
from torchrl_sparse.envs.contract import continued_source, task_contract
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.accelerate import run
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.calibration import calibrate_policy
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.diffusion.timesteps import find_timesteps
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.gates import make_gates
from torchrl_sparse.training.pruner.trainer import PrunerTrainer
from torchrl_sparse.training.state_model import fit_state_model

TASKS = ("Lift", "PickPlaceCan")
TRAINED = 12  # training steps, not the default
OLD_KEYS = ("robot0_gripper_qpos", "robot0_eef_quat_site", "object", "robot0_eef_pos")
CASES = [(policy, file) for policy in ("own", "old") for file in ("1.5", "1.4")][1:]


def as_of_14(task, objects):
    """robosuite 1.4's objects, by hand: Lift's vector to the cube has the other sign, Can's halves change places."""
    if task == "PickPlaceCan":
        return np.roll(objects, 7, axis=-1)
    return objects * np.where(np.arange(10) < 7, 1.0, -1.0)


def write(path, task, version, changes=()):
    """Three demonstrations of poses, in the form and the convention of a version of robosuite."""
    random = np.random.default_rng(0)
    is_old = version == "1.4"
    described = env_args_14 if is_old else partial(env_args_15, input_type="absolute")
    args = described(find_task(task), control_delta=False) | dict(changes)
    with h5py.File(path, "w") as file:
        for index in range(3):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = 9
            objects = random.uniform(-1, 1, (9, find_task(task).object_dim)).astype(np.float32)
            demo["obs/object"] = as_of_14(task, objects) if is_old else objects
            demo["obs/robot0_eef_pos"] = position = random.uniform(-1, 1, (9, 3))
            turn = np.array([3.1, 0.1, 0.0]) + random.uniform(-0.3, 0.3, (9, 3))
            demo["obs/robot0_eef_quat_site"] = Rotation.from_rotvec(turn).as_quat()
            demo["obs/robot0_gripper_qpos"] = random.uniform(-1, 1, (9, 2))
            pose = [position, np.tile([3.1, 0.1, 0.0], (9, 1)), random.choice([-1, 1], (9, 1))]
            demo["actions"] = np.concatenate(pose, 1)
        file["data"].attrs["env_args"] = json.dumps(args)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    return {
        (task, version): write(folder / f"{task}_{version}.h5", task, version)
        for task in TASKS
        for version in ("1.5", "1.4")
    }


def own_policy(task, path):
    """A tiny one in the conventions of policies that are trained here."""
    demos = contract_demos(path, task_contract(task))
    state, action = demos.data[keys.STATE], demos.data[keys.ACTION]
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        **{"input_dim": 10, "output_dim": 10, "horizon": 5, "n_obs_steps": 2, "cond_dim": state.shape[1]},
        **{"n_layer": 1, "n_head": 2, "n_emb": 16, "p_drop_attn": 0.0},
    )
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    normalizer = Normalizer.fit(state, action, state_mode="range", poses=True)
    sampler = Sampler("ddpm", 4, TRAINED)
    return DiffusionPolicy(network.eval(), normalizer, sampler=sampler, engine="reference")


def old_policy(task, path):
    """The same function of the same world, as it would be read of a checkpoint that was trained under robosuite 1.4."""
    policy, found = own_policy(task, path), find_task(task)
    places = torch.arange(found.state_dim)
    objects = found.state_slice("object")
    moved = as_of_14(task, places[objects].numpy() + 1)  # from 1, so that a sign is seen
    order = torch.cat(
        [
            torch.as_tensor(moved) if key == "object" else places[found.state_slice(key)] + 1
            for key in OLD_KEYS
        ]
    ).long()
    place, sign = order.abs() - 1, order.sign()
    with torch.no_grad():
        embedding = policy.network.cond_obs_emb
        embedding.weight.copy_(embedding.weight[:, place] * sign)
        policy.normalizer.state_scale.copy_(policy.normalizer.state_scale[place])
        policy.normalizer.state_offset.copy_(policy.normalizer.state_offset[place] * sign)
    policy.source = {
        **{"weights": "ema_model", "task": f"{found.alias}_lowdim", "robosuite": "1.4.1"},
        **{"n_action_steps": 3, "state_keys": list(OLD_KEYS)},
    }
    return policy


POLICIES = {"own": own_policy, "old": old_policy}


# -- whoever shows data to a policy ------------------------------------------------------------------------------------


def targets_of(policy, demos, source="data"):
    return make_targets(policy, demos, share=0.5, source=source, n_action_steps=3)


def taught(policy, demos, folder):
    return targets_of(policy, demos, "teacher")["target"]


def drawn(policy, demos, folder):
    targets = targets_of(policy, demos)
    one, other = (draw_answers(policy, targets, draws=2, n_action_steps=3, seed=seed) for seed in (0, 1))
    errors = offline_errors(one, targets["target"][:, 1:4].flatten(1), other)
    return [errors.error, errors.energy_score, errors.energy_distance]


def timesteps(policy, demos, folder):
    found = find_timesteps(policy, targets_of(policy, demos), "ddim", 2, strides=(3,), n_action_steps=3)
    return [found.error, *found.sampler.timesteps.tolist()]


def noise_left(policy, demos, folder):
    chain = Sampler("ddim", 2, TRAINED)
    found = carried_noise(policy, targets_of(policy, demos), chain, draws=3, n_action_steps=3)
    return [*found.correlation, found.spread, found.error]


def judged(policy, demos, folder):
    scores = Judge(policy, targets_of(policy, demos.between(1, 3)), draws=2, n_action_steps=3).scores(None)
    return torch.stack([*scores.values()])


def gates(policy, demos, folder):
    config = PrunerConfig(rate=0.5, batch_size=2, max_updates=2, checkpointed=False)
    trainer = PrunerTrainer(
        make_gates("l2c", policy, rate_input=False, seed=0),
        policy,
        targets_of(policy, demos, "teacher"),
        config,
    )
    return [trainer.train_step()["loss"] for _ in range(2)]


def training(policy, demos, folder):
    config = TrainConfig(max_steps=2, batch_size=4, n_action_steps=3, lr_warmup_steps=0, val_ratio=0.4)
    trainer = PolicyTrainer(policy, demos, config)
    return [trainer.train_step()["loss"], trainer.train_step()["loss"], trainer.validate()["loss"]]


def rolled(policy, demos, folder):
    return fit_state_model(demos, 1)[1]


def accelerated(policy, demos, folder):
    asked, options = ask(n_action_steps=3, windows=4), {"made_for": {"demos": "here"}, "make_env": None}
    grid = replace(GRID, samplers=("ddim2",), searched=(), cached=(), updates=(2,), intervals=(2,))
    found, _ = run.accelerate(policy, demos, folder, asked, grid=grid, **options)
    return [candidate.error for candidate in found.candidates.values()]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "consumer", [taught, drawn, timesteps, noise_left, judged, gates, training, rolled, accelerated]
)
def test_one_function_under_two_conventions_gives_one_number(consumer, task, files, tmp_path, monkeypatch):
    """robosuite's `object` changed its meaning between 1.4 and 1.5 (see tests/envs/test_conventions.py)."""
    monkeypatch.setattr(run, "time_queries", fixed_times({"ddim2": 5.0}))

    def measure(made, version):
        policy, path = POLICIES[made](task, files[task, "1.5"]), files[task, version]
        demos = policy_demos(path, task, policy)
        return torch.as_tensor(consumer(policy, demos, tmp_path / f"{made}_{version}"))

    expected = measure("own", "1.5")
    for case in CASES:
        torch.testing.assert_close(measure(*case), expected, rtol=2e-4, atol=2e-5)


def test_so_it_does_in_the_environment(files):
    """What benchmarks, calibrations and evaluations play and calibrate on is made for the policy as well."""
    played, calibrated = [], []
    for make in POLICIES.values():
        policy = make("Lift", files["Lift", "1.5"])
        env = diffusion_env("Lift", policy, 3)
        calibrated.append(calibrate_policy(policy, env, [7]).similarity)
        episode = env(seeds=[7]).rollout(3, ChunkExecutor(policy, 3))
        played.append(episode[keys.ACTION])
    torch.testing.assert_close(*played, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(*calibrated, rtol=1e-4, atol=1e-4)


# -- whoever goes on from one ------------------------------------------------------------------------------------------

SMALL = ["batch_size=4", "max_steps=1", "train.val_ratio=0", "lr=1e-20"]


@pytest.mark.parametrize("version", ["1.5", "1.4"])
def test_a_policy_that_is_trained_on_keeps_what_it_was_trained_with(files, tmp_path, version):
    """Noise levels, normaliser and the order of the state are the network's, whatever the new data are recorded in."""
    old = old_policy("Lift", files["Lift", "1.5"])
    old.save_pretrained(tmp_path / "old", half=False)
    demos, out = files["Lift", version], tmp_path / "run"
    train_unbroken("train_policy", out, [f"demos={demos}", f"init={tmp_path}/old", *SMALL])
    again = DiffusionPolicy.from_pretrained(out / "policy", engine="reference")
    assert again.source == old.source
    assert again.sampler.config == old.sampler.config
    assert all(
        torch.equal(a, b) for a, b in zip(again.normalizer.buffers(), old.normalizer.buffers(), strict=True)
    )
    shown = [policy_demos(demos, "Lift", policy) for policy in (old, again)]
    torch.testing.assert_close(
        *(taught(p, d, None) for p, d in zip((old, again), shown, strict=True)), atol=5e-3, rtol=0
    )


def test_windows_of_a_policy_that_is_trained_on_end_where_its_chunks_do(files, tmp_path):
    """Its source says how many actions of a chunk are executed, which decides the last windows of an episode."""
    old_policy("Lift", files["Lift", "1.5"]).save_pretrained(tmp_path / "old")
    with hydra.initialize_config_dir(str(RECIPES), version_base=None):
        options = [f"demos={files['Lift', '1.5']}", f"init={tmp_path}/old", f"out={tmp_path}/run", *SMALL]
        trainer = load_recipe("train_policy").make_trainer(hydra.compose("train_policy", options))
    assert trainer.config.n_action_steps == 3


def test_noise_levels_of_another_training_are_refused(files):
    """A timestep means a noise level only together with the number of training steps."""
    policy = own_policy("Lift", files["Lift", "1.5"])
    with refused("sampler"):
        policy.sampler = Sampler("ddim", 4)
    with refused("sampler"):
        policy.with_plan(None, Sampler("ddim", 4))
    assert policy.num_inference_steps == 4


def test_a_policy_of_a_task_is_trained_on_for_a_variant_and_then_says_so(files):
    """assets/can_two_ways began from assets/can so."""
    policy = own_policy("PickPlaceCan", files["PickPlaceCan", "1.5"])
    assert continued_source("can_two_ways", policy) == {}
    policy.source = {"task": "can_lowdim", "n_action_steps": 3}
    assert continued_source("can_two_ways", policy) == {"task": "can_two_ways", "n_action_steps": 3}
    with refused("policy"):
        continued_source("lift", policy)
