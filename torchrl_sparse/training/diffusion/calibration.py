"""Calibration of a policy on observations from its environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

import torch
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.calibration import Calibration, calibrate
from torchrl_sparse.envs.seeds import CALIBRATION_SEED, tuning_seeds
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["calibrate_policy", "lazy_calibration"]


def calibrate_policy(
    policy: DiffusionPolicy, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> Calibration:
    """Calibrate on the first observation of one episode per seed; BAC's release uses a single one."""
    env = make_env(seeds=list(seeds))
    first = torch.stack([env.reset() for _ in seeds]).to(policy.device)
    env.close()
    encoded = policy.module["encode"](first)
    noise = policy.sample_noise(encoded[keys.SEED].squeeze(-1))
    return calibrate(policy.network, policy.sampler, noise, encoded[keys.COND])


def lazy_calibration(
    policy: DiffusionPolicy, make_env: Callable[..., EnvBase], samples: int
) -> Callable[[], Calibration]:
    """Return a function that calibrates on that many first observations when first called."""
    return cache(partial(calibrate_policy, policy, make_env, tuning_seeds(CALIBRATION_SEED, samples)))
