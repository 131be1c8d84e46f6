"""The methods of a benchmark by name, and the queries on which they are compared."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.bac import SCHEDULES
from torchrl_sparse.blocks.calibration import Calibration, calibrate
from torchrl_sparse.blocks.planner import Dense, Planner
from torchrl_sparse.blocks.static import Schedule, StaticSchedule
from torchrl_sparse.blocks.uniform import Uniform
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule

_CAMERA_OPTIONS = {"image": "camera", "wrist_image": "wrist_camera"}
METHODS = "dense, ddim<N>, uniform, " + ", ".join(SCHEDULES)


def check_method(name: str) -> None:
    """Raises ValueError unless ``name`` is one of `METHODS`."""
    if name not in ("dense", "uniform", *SCHEDULES) and not re.fullmatch(r"ddim[1-9]\d*", name):
        raise ValueError(f"methods: expected {METHODS}, got {name!r}")


def make_method(
    name: str,
    policy: DiffusionPolicy,
    *,
    num_updates: int,
    schedules: Path,
    calibration: Callable[[], Calibration],
) -> DiffusionPolicy:
    """The policy under one method; it shares the network with ``policy``.

    Args:
        name: one of `METHODS`.
        policy: the trained policy with its own sampler.
        num_updates: M of the BAC schedules, and updates of ``uniform``.
        schedules: folder in which ``<name>.json`` is looked for; a schedule that is not there, or was made with another M, is
            computed.
        calibration: called where a schedule has to be computed.

    Raises:
        ValueError: for an unknown name, or a schedule that was made for another policy.
    """
    check_method(name)
    schedule, plan = policy.schedule, Dense()
    if name.startswith("ddim"):
        steps = int(name.removeprefix("ddim"))
        schedule = NoiseSchedule("ddim", steps, policy.schedule.num_train_timesteps)
    elif name == "uniform":
        plan = Uniform(interval=-(-policy.num_inference_steps // num_updates))
    elif name in SCHEDULES:
        plan = _bac(name, policy, num_updates, schedules, calibration)
    return DiffusionPolicy(
        policy.network,
        policy.normalizer,
        vision=policy.vision,
        schedule=schedule,
        plan=plan,
        engine=policy.engine,
    )


def _bac(name, policy, num_updates, schedules, calibration) -> Planner:
    path = schedules / f"{name}.json"
    if path.exists():
        found = Schedule.load(path)
        if found.settings.get("num_updates") == num_updates:
            return StaticSchedule(found)
    return StaticSchedule(SCHEDULES[name](calibration(), num_updates, policy=policy.fingerprint))


def env_options(policy: DiffusionPolicy) -> dict[str, Any]:
    """Arguments of `make_env` for an environment that shows what ``policy`` observes.

    Raises:
        ValueError: if the policy has cameras and its ``source`` does not say which.
    """
    options: dict[str, Any] = {"n_obs_steps": policy.n_obs_steps}
    if policy.vision is None:
        return options
    named = policy.source.get("cameras", {})
    cameras = {name: named.get(name, "").removesuffix("_image") for name in policy.vision.cameras}
    if not all(cameras.values()) or not cameras.keys() <= _CAMERA_OPTIONS.keys():
        raise ValueError(f"policy.source['cameras']: expected those of {list(_CAMERA_OPTIONS)}, got {named}")
    options |= {_CAMERA_OPTIONS[name]: camera for name, camera in cameras.items()}
    return options | {"image_size": policy.vision.image_size[0], "object_state": False}


def calibrate_policy(
    policy: DiffusionPolicy, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> Calibration:
    """Calibrates on the first observation of one episode per seed, as BAC's release does with a single one."""
    env = make_env(seeds=list(seeds))
    first = torch.stack([env.reset() for _ in seeds])
    env.close()
    encoded = policy.module["encode"](first)
    noise = policy.sample_noise(encoded[keys.SEED].squeeze(-1))
    return calibrate(policy.network, policy.schedule, noise, encoded[keys.COND])


def record_queries(
    actor: ChunkExecutor, make_env: Callable[..., EnvBase], seeds: Sequence[int]
) -> TensorDictBase:
    """Every query of one episode per seed: [number of queries], with what the policy read and what it answered."""
    env = make_env(seeds=list(seeds))
    episodes = [env.rollout(env.base_env.horizon, actor) for _ in seeds]
    env.close()
    wanted = [*actor.policy.in_keys, *actor.policy.out_keys]
    return torch.cat([steps[steps[keys.QUERIED].squeeze(-1)].select(*wanted) for steps in episodes])


def answer(policy: DiffusionPolicy, queries: TensorDictBase) -> TensorDict:
    """Asks another method the same: same observations, same noise."""
    with torch.no_grad():
        return policy(queries.select(*policy.in_keys))
