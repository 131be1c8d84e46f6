"""Comparing a policy that LeRobot wrote with what LeRobot answered, see ``tests/peers/lerobot/write_policies.py``."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from tensordict import NonTensorStack, TensorDict

from torchrl_sparse import DiffusionPolicy

TASKS = ["push the red cube", "pick it", "push the red cube"]
MOST = 1e-5
"""Largest error, in shares of an action's range."""


def observations(folder: Path, policy: DiffusionPolicy) -> TensorDict:
    """Return the observations that LeRobot was asked about, under this library's keys."""
    kept = load_file(folder / "reference.safetensors")
    cameras = policy.source["cameras"].items()
    history = {"state": kept["observation.state"], **{name: kept[key] for name, key in cameras}}
    return TensorDict({"history": history, "language_instruction": NonTensorStack(*TASKS)}, [3])


def error(folder: Path, policy: DiffusionPolicy) -> float:
    """Return the largest difference to LeRobot's chunk for its own noise, in shares of each action's range."""
    kept = load_file(folder / "reference.safetensors")
    cond = policy(observations(folder, policy))["diffusion", "cond"]
    noise = torch.zeros(3, policy.num_inference_steps, policy.horizon, policy.network.input_dim)
    noise[:, : kept["noise"].shape[1]] = kept["noise"]
    actions = policy.normalizer.unnormalize_action(policy.denoise(noise, cond))
    first, count = policy.n_obs_steps - 1, policy.source["n_action_steps"]
    expected = kept["action"]
    extent = expected.amax((0, 1)) - expected.amin((0, 1))
    return ((actions[:, first : first + count] - expected).abs().amax((0, 1)) / extent).max().item()
