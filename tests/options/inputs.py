"""What the runs begin with: demonstrations of random arrays and tiny policies, made without a simulator or a training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import torch

from tests.fixtures.demonstrations import describe, describe_state_task, hands
from torchrl_sparse import DiffusionPolicy, SAGPruner, keys
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo
from torchrl_sparse.data.for_policy import contract_demos, instructed_demos
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.envs.contract import task_contract
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.storage.vla import VLASource
from torchrl_sparse.training.diffusion.untrained import untrained_policy
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations
from torchrl_sparse.training.vla.untrained import untrained_policy as untrained_vla

STEPS = 15
"""Of each demonstration."""
SMALL = {"horizon": 10, "n_obs_steps": 2, "n_layer": 2, "n_head": 2, "n_emb": 16}


def write_demos(path: Path, number: int, *, cameras: Sequence[str] = (), pixels: int = 40) -> Path:
    """Write demonstrations of Lift; the first two are listed under the key ``few``."""
    random = np.random.default_rng(number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for index in range(number):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = STEPS
            demo["actions"] = actions = random.uniform(-1, 1, (STEPS, 7))
            demo["obs/robot0_eef_pos"], demo["obs/robot0_eef_quat_site"] = hands(actions)
            demo["obs/object"] = random.uniform(-1, 1, (STEPS, 10))
            demo["obs/robot0_gripper_qpos"] = random.uniform(-1, 1, (STEPS, 2))
            for camera in cameras:
                demo[f"obs/{camera}"] = random.integers(256, size=(STEPS, pixels, pixels, 3), dtype=np.uint8)
        file["mask/few"] = np.array([b"demo_0", b"demo_1"])
        describe(file)
    return path


def write_state_demos(path: Path, task: str, sizes: tuple[int, int], number: int = 2) -> Path:
    """Write demonstrations of a task outside robosuite, with states and actions of these sizes."""
    random = np.random.default_rng(0)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for index in range(number):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = STEPS
            demo["obs/state"], demo["actions"] = (random.uniform(-1, 1, (STEPS, size)) for size in sizes)
        describe_state_task(file, task)
    return path


def write_policy(folder: Path, demos: Path, task: str = "lift", **sizes: int) -> DiffusionPolicy:
    """Write an untrained policy of a task, whose weights are large enough for every block to matter."""
    shown = contract_demos(demos, task_contract(task))
    policy = untrained_policy(shown, SMALL | sizes, poses=shown.data[keys.ACTION].shape[-1] == 10)
    for parameter in policy.network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    policy.sampler = policy.sampler.variant("ddpm", 20)
    policy.save_pretrained(folder)
    return policy


def write_pruner(folder: Path, policy: DiffusionPolicy) -> None:
    """Write an untrained pruner of a policy, for chains of two steps."""
    sampler = policy.sampler.variant("ddim", 2)
    shape = (policy.n_obs_steps, policy.network.cond_dim)
    network = PrunerNetwork(sampler.timesteps.tolist(), policy.num_blocks, shape, width=16)
    SAGPruner(network, PrunerInfo(policy.fingerprint, sampler.name, 0.5)).save_pretrained(folder)


def write_reach(folder: Path, task: str = "Reach", **sizes: int) -> DiffusionPolicy:
    """Write such a policy for one of the tasks that cost nothing, and its demonstrations where recipes look for them."""
    demos = folder.parents[1 if folder.parent.name == "assets" else 0] / f"data/{task.lower()}_proficient.h5"
    write_state_demos(demos, task, (1, 1))
    return write_policy(folder, demos, task, **sizes)


def write_vla(folder: Path, demos: Path, task: str = "lift_named", **sizes: int) -> None:
    """Write a tiny untrained vision-language-action policy of a task."""
    cameras = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
    shown = InstructedDemonstrations(instructed_demos(demos, task, cameras), read_instructions(demos))
    policy = untrained_vla(shown, "tiny", cameras=[*cameras], changes=sizes)
    policy.source = VLASource(find_task(task).name, cameras)
    policy.save_pretrained(folder)
