"""Execution of a method's chunks: how often the policy is called, for how many samples, with which controller."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.realtime_executor import RealtimeExecutor
from torchrl_sparse.control.roll_forward import RollForward, StateModel
from torchrl_sparse.control.selectors import CoherentChunk
from torchrl_sparse.control.temporal_ensemble import TemporalEnsemble
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.diffusion import make_controller
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["execution_options", "executed_every", "make_executor", "make_realtime_executor"]


def executed_every(method: MethodSpec | str, policy: DiffusionPolicy, n_action_steps: int) -> int:
    """Return the environment steps between two policy calls of a method.

    Args:
        method: such as ``"ddpm3_logsnr_every2"``.
        policy: whose chunks they are.
        n_action_steps: of methods that do not say.

    Raises:
        InputError: if a chunk has fewer actions than the method says.
    """
    every, length = MethodSpec.parse(method).every, policy.horizon - policy.n_obs_steps + 1
    if every is not None and every > length:
        raise InputError(f"methods: {method}: expected at most the {length} actions of a chunk, got {every}")
    return every or n_action_steps


def execution_options(method: MethodSpec | str) -> dict[str, Any]:
    """Return ``num_samples`` and ``selector`` of an executor: backward coherence alone if several chunks are sampled."""
    samples = MethodSpec.parse(method).samples
    selector: TensorDictModuleBase | None = CoherentChunk() if samples > 1 else None
    return {"num_samples": samples, "selector": selector}


def make_executor(method: MethodSpec | str, policy: DiffusionPolicy, n_action_steps: int) -> ChunkExecutor:
    """Return the executor of a method's chunks; arguments are those of `executed_every`.

    Raises:
        InputError: as `executed_every`, and for a method that looks ahead to when its answer begins: this world waits.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> actor = make_executor("dense_every2_of4", policy, 8)
        >>> actor.n_action_steps, actor.num_samples
        (2, 4)
    """
    if MethodSpec.parse(method).ahead:
        raise InputError(f"methods: {method}: expected no _ahead where the world waits for an answer")
    steps = executed_every(method, policy, n_action_steps)
    return ChunkExecutor(
        _averaged(method, policy), steps, make_controller(method), **execution_options(method)
    )


def make_realtime_executor(
    method: MethodSpec | str,
    policy: DiffusionPolicy,
    n_action_steps: int,
    *,
    hold: TensorDictModuleBase,
    latency: float,
    control_freq: float,
    model: StateModel | None = None,
) -> RealtimeExecutor:
    """Return the executor of a method's chunks under inference delay.

    Args:
        method, policy, n_action_steps: of `executed_every`.
        hold, latency, control_freq: of `RealtimeExecutor`.
        model: what methods named ``_ahead`` roll the state forward with.

    Raises:
        InputError: as `executed_every`, and for an ``_ahead`` without a model.
    """
    asked: TensorDictModuleBase = policy
    if MethodSpec.parse(method).ahead:
        if model is None:
            raise InputError(
                f"methods: {method}: expected demos, to which the model of the state is fitted, got none"
            )
        asked = RollForward(policy, model.to(policy.device))
    every = executed_every(method, policy, n_action_steps)
    averaged, options = _averaged(method, asked), execution_options(method)
    return RealtimeExecutor(averaged, hold, every, latency=latency, control_freq=control_freq, **options)


def _averaged(method: MethodSpec | str, policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """Return the policy, its chunks averaged over policy calls where the method says so."""
    return TemporalEnsemble(policy) if MethodSpec.parse(method).ensembled else policy
