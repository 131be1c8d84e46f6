"""Episodes of a method in a world that does not wait for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from torchrl_sparse.control.realtime_executor import HoldPose
from torchrl_sparse.control.roll_forward import StateModel
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.evaluate import episode_log, evaluate
from torchrl_sparse.methods.diffusion import method_identity
from torchrl_sparse.methods.executor import make_realtime_executor
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.trainer import checksum

__all__ = ["evaluate_late"]


def evaluate_late(
    name: MethodSpec | str,
    policy: DiffusionPolicy,
    delay_steps: int,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    settings: dict[str, Any],
    control_freq: float,
    model: StateModel | None,
    out: str | Path,
    **options: Any,
) -> list[EpisodeResult]:
    """Run the episodes of a method whose answers come ``delay_steps`` late, or read them where an earlier run left them.

    Args:
        name: the method.
        policy: the method's.
        make_env, seeds: of `evaluate`.
        settings: ``"task"``, ``"horizon"`` and ``"n_action_steps"``, which decide how the episodes go.
        control_freq: steps a second.
        model: of `make_realtime_executor`.
        out: folder in which the episodes are kept.
        options: of `evaluate`.

    Raises:
        ValueError: as `make_realtime_executor`.
    """
    actor = make_realtime_executor(
        name,
        policy,
        settings["n_action_steps"],
        hold=HoldPose(find_robosuite_task(settings["task"]).pose_slices()),
        latency=delay_steps / control_freq,
        control_freq=control_freq,
        model=model,
    )
    late = {"n_action_steps": actor.n_action_steps, "delay_steps": delay_steps}
    if MethodSpec.parse(name).ahead:
        late["state_model"] = checksum(model.weight)
    log = episode_log(out, f"{name}_delay{delay_steps}")
    identity = {**method_identity(name, policy), **settings, **late}
    return evaluate(f"{name} +{delay_steps}", actor, make_env, seeds, log=log, identity=identity, **options)
