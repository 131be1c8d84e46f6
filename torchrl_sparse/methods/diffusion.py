"""The methods of a diffusion policy by name: planner and sampler, controller, and colour in figures.

A method is a `MethodSpec` or its label. The planner is a key of :data:`METHODS`, or a saved one, ``NAME.json`` or ``NAME/``,
which brings the sampler that it was made for. ``NAME@RATE`` asks every policy call for that prune rate; with
``NAME@COARSE-FINE`` a controller asks for the first rate in coarse motion and for the second in fine motion.

==================== ===========================================================================================
``ddpm_82_14``       a sampler with its steps, nothing pruned
``uniform``          every block each ``-(-K // M)``-th step, as released
``uniform7``         every block each 7th step and in the last
``uniform2_ddpm10``  the same of another sampler
``ddpm10_warm2``     a sampler, of which calls that have a last chunk take the last 2 steps, from it
``ddpm5_logsnr_rtc`` a sampler, whose calls are guided toward what is left of the last chunk
``sag:int8@0.9``     a saved planner, run in the native engine with rounded weights and activations
==================== ===========================================================================================

A method of one's own is one line, executed before its name is used::

    METHODS["mine"] = Method(lambda inputs: (MyPlanner(), inputs.sampler))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_sparse.blocks.bac import SCHEDULES
from torchrl_sparse.blocks.calibration import Calibration
from torchrl_sparse.blocks.planner import Dense, Planner, PlanSpec
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.blocks.uniform import Uniform
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.errors import InputError
from torchrl_sparse.keys import PRUNE_RATE
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.diffusion.realtime_chunking import RealtimeChunking
from torchrl_sparse.policies.diffusion.warm_start import QueryStart, WarmStart
from torchrl_sparse.runtime.names import did_you_mean

__all__ = [
    "METHODS",
    "Method",
    "MethodInputs",
    "check_method",
    "make_controller",
    "make_method",
]


@dataclass(frozen=True)
class MethodInputs:
    """Inputs from which methods are made.

    Attributes:
        method: what is made.
        spec: the policy, with its own sampler.
        sampler: the method's, else the policy's own.
        num_updates: M, how often ``uniform`` and BAC compute a block.
        planners: folder of saved planners.
        calibration: makes a calibration of the policy; called where one is needed.
    """

    method: MethodSpec
    spec: PlanSpec
    sampler: Sampler
    num_updates: int
    planners: Path
    calibration: Callable[[], Calibration]


def move_rate(rates: tuple[float, ...]) -> ActionAwareController | None:
    """Return the controller that switches between two given prune rates; None for fewer."""
    if len(rates) < 2:
        return None
    coarse, fine = rates
    return ActionAwareController(coarse=coarse, fine=fine, budget_key=PRUNE_RATE)


@dataclass(frozen=True)
class Method:
    """One entry of the method table.

    Attributes:
        make: returns planner and sampler; ValueError where the inputs do not allow it.
        controller: returns what a `ChunkExecutor` runs at every step beside the policy, given the rates that were
            written, or None.
        color: in figures, such as ``"#0072B2"``; None takes what is left.
        noise: stream of the noise that it draws; 0 is what all methods share, so that they can be paired.
        start: returns what policy calls begin from where the name does not say it; None is noise.
    """

    make: Callable[[MethodInputs], tuple[Planner, Sampler]]
    controller: Callable[[tuple[float, ...]], TensorDictModuleBase | None] = move_rate
    color: str | None = None
    noise: int = 0
    start: Callable[[MethodInputs], QueryStart | None] = lambda inputs: None


def _dense(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    return Dense(), inputs.sampler


def _uniform(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    interval = inputs.method.interval
    own = -(-inputs.spec.num_inference_steps // inputs.num_updates)
    return Uniform(interval or own, last=interval is not None), inputs.sampler


def _bac(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Take the saved schedule if it has as many updates, else make one."""
    path = inputs.planners / f"{inputs.method.planner}.json"
    schedule = CacheSchedule.from_pretrained(path) if path.exists() else None
    if schedule is None or schedule.settings.get("num_updates") != inputs.num_updates:
        make = SCHEDULES[inputs.method.planner]
        schedule = make(inputs.calibration(), inputs.num_updates, policy=inputs.spec.policy)
    return SchedulePlanner(schedule), inputs.sampler


def _saved(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Load a planner; its sampler is the one that it was made for."""
    path = _saved_path(inputs.planners, inputs.method.planner)
    assert path is not None  # or `_find` had refused the name
    planner, sampler = load_planner(path), inputs.sampler
    if (spec := planner.made_for) is not None:
        sampler = sampler.variant_named(spec.sampler, spec.num_inference_steps)
    return planner, sampler


# Okabe and Ito's colours, which stay apart for colour-blind readers.
METHODS: dict[str, Method] = {
    "dense": Method(_dense, color="#333333"),
    "dense_noise": Method(_dense, color="#9A9AA0", noise=1),
    "ddim10": Method(_dense, color="#E69F00"),
    "uniform": Method(_uniform, color="#56B4E9"),
    "bac": Method(_bac, color="#0072B2"),
    "bac_blockwise": Method(_bac, color="#D55E00"),
    "bac_unified": Method(_bac, color="#CC79A7"),
}
"""Name -> method. Planners that are saved in a folder need no line: their files say what they are."""

SAVED = Method(_saved)


def check_method(method: MethodSpec | str, planners: Path) -> None:
    """Raise InputError unless a label follows `MethodSpec` and its method is known or saved in ``planners``."""
    _find(method, planners)


def make_method(
    method: MethodSpec | str,
    policy: DiffusionPolicy,
    *,
    num_updates: int,
    planners: Path,
    calibration: Callable[[], Calibration],
) -> DiffusionPolicy:
    """Return the policy under a method; it shares its networks with ``policy``.

    Args:
        method: see the module.
        policy: the trained policy with its own sampler.
        num_updates, planners, calibration: see `MethodInputs`. A BAC schedule that is not in ``planners``, or was made
            with another M, is computed.

    Raises:
        InputError: for an unknown name, a planner that was made for another policy, or a rate that it does not take.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> options = {"num_updates": 10, "planners": Path("assets/lift"), "calibration": lambda: None}
        >>> make_method("ddim10", policy, **options).num_inference_steps
        10
        >>> make_method("sag", policy, **options).plan.is_static
        False
        >>> make_method("dense:int8", policy, **options).engine
        'native_int8'
    """
    written, recipe = MethodSpec.parse(method), _find(method, planners)
    sampler = policy.sampler if written.sampler is None else policy.sampler.variant_named(written.sampler)
    inputs = MethodInputs(written, policy.plan.spec, sampler, num_updates, planners, calibration)
    planner, sampler = recipe.make(inputs)
    if written.rates:
        _ask_for(planner, written)
    start = WarmStart(written.warm) if written.warm else recipe.start(inputs)
    start = RealtimeChunking() if written.rtc else start
    made = policy.with_plan(planner, sampler, start).to(policy.device)
    if recipe.noise:
        made = made.with_noise(recipe.noise)
    if written.weights:
        made.engine = f"native_{written.weights}"
    return made


def make_controller(method: MethodSpec | str) -> TensorDictModuleBase | None:
    """Return the controller of a method, saved methods included."""
    written = MethodSpec.parse(method)
    return (_lookup(written) or SAVED).controller(written.rates)


def method_identity(method: MethodSpec | str, policy: DiffusionPolicy) -> dict[str, Any]:
    """Return the JSON values that tell one method's episodes from others', for an `EpisodeLog`.

    Args:
        method: as it is to be called.
        policy: as :func:`make_method` returned it.
    """
    other_noise = {"noise": policy.noise_stream} if policy.noise_stream else {}
    start = {"start": policy.start.name} if policy.start.name else {}
    return {
        "method": str(method),
        "policy": policy.fingerprint,
        "engine": policy.engine,
        "sampler": policy.sampler.config,
        "planner": policy.plan.fingerprint,
        **other_noise,
        **start,
    }


def _find(method: MethodSpec | str, planners: Path) -> Method:
    written = MethodSpec.parse(method)
    name = written.planner
    if written.like is not None or any(rate >= 1 for rate in written.rates):
        raise InputError(f"methods: expected {name}@RATE of rates below 1, got {str(method)!r}")
    if (known := _lookup(written)) is not None:
        return known
    if _saved_path(planners, name) is None:
        saved = [path.stem for path in sorted(planners.glob("*")) if _saved_path(planners, path.stem)]
        raise InputError(
            f"methods: expected {', '.join(METHODS)}, or a planner in {planners} ({name}.json or {name}/), "
            "or a sampler, such as ddpm5_logsnr, ddpm_82_14, ddpm10_warm2, ddpm10_rtc or uniform2_ddpm10, "
            f"got {str(method)!r}{did_you_mean(name, [*METHODS, *saved])}"
        )
    return SAVED


def _lookup(written: MethodSpec) -> Method | None:
    return METHODS.get(written.name) or METHODS.get(written.planner)


def _saved_path(planners: Path, name: str) -> Path | None:
    file, folder = planners / f"{name}.json", planners / name
    if file.is_file():
        return file
    return folder if (folder / "config.json").is_file() else None


def _ask_for(planner: Planner, written: MethodSpec) -> None:
    """Set the rate of policy calls that bring none. Both rates are tried: a wrong one is found now and not in mid-episode."""
    if planner.rate is None:
        raise InputError(
            f"methods: {written.name}: expected a planner that takes a prune rate, got {type(planner).__name__}"
        )
    for rate in reversed(written.rates):
        planner.rate = rate
