"""The methods of a benchmark by name, and the queries on which they are compared."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
from torchrl_sparse.evaluation.latency import Latency, measure_latency
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule

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
        policy.network, policy.normalizer, schedule=schedule, plan=plan, engine=policy.engine
    )


def _bac(name, policy, num_updates, schedules, calibration) -> Planner:
    path = schedules / f"{name}.json"
    if path.exists():
        found = Schedule.load(path)
        if found.settings.get("num_updates") == num_updates:
            return StaticSchedule(found)
    return StaticSchedule(SCHEDULES[name](calibration(), num_updates, policy=policy.fingerprint))


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
        return policy(queries.select(keys.HISTORY_STATE, keys.EPISODE_SEED, keys.EPISODE_STEP))


def method_identity(name: str, policy: DiffusionPolicy) -> dict[str, Any]:
    """What makes the episodes of one method its own, as JSON values for an `EpisodeLog`."""
    mask = policy.plan.mask(policy.plan.spec)
    return {
        "method": name,
        "policy": policy.fingerprint,
        "engine": policy.engine,
        "sampler": policy.schedule.config,
        "mask": hashlib.sha256(mask.numpy().tobytes()).hexdigest()[:16],
    }


def time_queries(
    methods: Mapping[str, DiffusionPolicy],
    query: TensorDictBase,
    *,
    repeats: int,
    threads: int,
    on_round: Callable[[int, int], None] | None = None,
) -> dict[str, Latency]:
    """Latency of one recorded query under each method, interleaved; see `measure_latency`."""
    calls = {name: partial(answer, method, query) for name, method in methods.items()}
    return measure_latency(calls, repeats=repeats, threads=threads, on_round=on_round)
