"""The methods of a diffusion policy by name: planner and sampler, controller, and colour in figures.

A method is written ``NAME``, ``NAME@RATE`` (every query is asked for that prune rate) or ``NAME@COARSE-FINE`` (a
controller asks for the first rate in coarse motion and for the second in fine motion). ``NAME:bf16`` and ``NAME:int8``, of
any of them (``sag:int8@0.9``), run it in the native engine with rounded weights and activations. ``NAME_every2`` queries
every two steps, ``NAME_of8`` samples eight chunks and plays one, ``NAME_every2_ensembled`` averages chunks over queries;
``NAME_ahead`` is for a world that does not wait (:mod:`torchrl_sparse.methods.executor`). NAME is a key of :data:`METHODS`,
matches the pattern of one, or names a saved planner, ``NAME.json`` or ``NAME/``, which brings the sampler it was made for.

==================== ===========================================================================================
``ddpm_82_14``       a sampler with its steps, as :mod:`torchrl_sparse.networks.diffusion.naming` says, nothing pruned
``uniform``          every block each ``-(-K // M)``-th step, as released
``uniform7``         every block each 7th step and in the last
``uniform2_ddpm10``  the same of another sampler
``ddpm10_warm2``     a sampler, of which queries that have a last chunk take the last 2 steps, from it
``ddpm5_logsnr_rtc`` a sampler, whose queries are drawn to what is left of the last chunk
==================== ===========================================================================================

A method of one's own is one line, executed before its name is used::

    METHODS["mine"] = Method(lambda inputs: (MyPlanner(), inputs.sampler))
"""

from __future__ import annotations

import re
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
from torchrl_sparse.methods.names import MethodName
from torchrl_sparse.networks.diffusion.naming import CHAIN_PATTERN
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.diffusion.realtime_chunking import RealtimeChunking
from torchrl_sparse.policies.diffusion.warm_start import ColdStart, WarmStart
from torchrl_sparse.runtime.names import did_you_mean

__all__ = [
    "METHODS",
    "Method",
    "MethodInputs",
    "MethodName",
    "check_method",
    "make_controller",
    "make_method",
]


@dataclass(frozen=True)
class MethodInputs:
    """Everything that a method may be made from.

    Attributes:
        name: the method's, without rates.
        spec: the policy, with its own sampler.
        sampler: the policy's own.
        num_updates: M, how often ``uniform`` and BAC compute a block.
        planners: folder of saved planners.
        calibration: makes a calibration of the policy; called where one is needed.
    """

    name: str
    spec: PlanSpec
    sampler: Sampler
    num_updates: int
    planners: Path
    calibration: Callable[[], Calibration]


def move_rate(rates: tuple[float, ...]) -> ActionAwareController | None:
    """Return what moves the prune rate between two that were written, and nothing for one or none."""
    if len(rates) < 2:
        return None
    coarse, fine = rates
    return ActionAwareController(coarse=coarse, fine=fine, budget_key=PRUNE_RATE)


@dataclass(frozen=True)
class Method:
    """Recipe of a method.

    Attributes:
        make: returns planner and sampler; ValueError where the inputs do not allow it.
        pattern: regular expression of further names that it goes by; ``inputs.name`` says which.
        controller: returns what a `ChunkExecutor` runs at every step beside the policy, given the rates that were
            written, or None.
        color: in figures, such as ``"#0072B2"``; None takes what is left.
        noise: stream of the noise that it draws; 0 is what all methods share, so that they can be paired.
        start: returns what queries begin from; None is noise.
    """

    make: Callable[[MethodInputs], tuple[Planner, Sampler]]
    pattern: str | None = None
    controller: Callable[[tuple[float, ...]], TensorDictModuleBase | None] = move_rate
    color: str | None = None
    noise: int = 0
    start: Callable[[MethodInputs], ColdStart | None] = lambda inputs: None


def _dense(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    return Dense(), inputs.sampler


def _sampler(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Take the sampler of the name."""
    chain = inputs.name.partition("_warm")[0].removesuffix("_rtc")
    return Dense(), inputs.sampler.variant_named(chain)


def _warm(inputs: MethodInputs) -> WarmStart:
    """Take the steps of the name."""
    return WarmStart(int(inputs.name.rpartition("_warm")[2]))


def _realtime_chunking(inputs: MethodInputs) -> RealtimeChunking:
    return RealtimeChunking()


def _uniform(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    return Uniform(interval=-(-inputs.spec.num_inference_steps // inputs.num_updates)), inputs.sampler


def _uniform_and_last(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Take interval and, where it is written, sampler of the name."""
    interval, _, chain = inputs.name.removeprefix("uniform").partition("_")
    sampler = inputs.sampler
    if chain:
        sampler = sampler.variant_named(chain)
    return Uniform(int(interval), last=True), sampler


def _bac(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Take the saved schedule if it has as many updates, else make one."""
    path = inputs.planners / f"{inputs.name}.json"
    schedule = CacheSchedule.from_pretrained(path) if path.exists() else None
    if schedule is None or schedule.settings.get("num_updates") != inputs.num_updates:
        make = SCHEDULES[inputs.name]
        schedule = make(inputs.calibration(), inputs.num_updates, policy=inputs.spec.policy)
    return SchedulePlanner(schedule), inputs.sampler


def _saved(inputs: MethodInputs) -> tuple[Planner, Sampler]:
    """Load a planner; its sampler is the one that it was made for."""
    path = _saved_path(inputs.planners, inputs.name)
    assert path is not None  # or `find_method` had refused the name
    planner, sampler = load_planner(path), inputs.sampler
    if (spec := planner.made_for) is not None:
        sampler = sampler.variant_named(spec.sampler, spec.num_inference_steps)
    return planner, sampler


# Okabe and Ito's colours, which stay apart for colour-blind readers.
METHODS: dict[str, Method] = {
    "dense": Method(_dense, color="#333333"),
    "dense_noise": Method(_dense, color="#9A9AA0", noise=1),
    "ddim10": Method(_sampler, color="#E69F00"),
    "<sampler><steps>, <sampler>_<t>_<t>...": Method(_sampler, pattern=CHAIN_PATTERN),
    "<sampler>..._warm<steps>": Method(_sampler, pattern=rf"{CHAIN_PATTERN}_warm[1-9]\d*", start=_warm),
    "<sampler>..._rtc": Method(_sampler, pattern=rf"{CHAIN_PATTERN}_rtc", start=_realtime_chunking),
    "uniform": Method(_uniform, color="#56B4E9"),
    "uniform<interval>[_<sampler>]": Method(
        _uniform_and_last, pattern=rf"uniform[1-9]\d*(_{CHAIN_PATTERN})?"
    ),
    "bac": Method(_bac, color="#0072B2"),
    "bac_blockwise": Method(_bac, color="#D55E00"),
    "bac_unified": Method(_bac, color="#CC79A7"),
}
"""Name -> method. Planners that are saved in a folder need no line: their files say what they are."""

SAVED = Method(_saved)


def check_method(text: str, planners: Path) -> None:
    """Raise ValueError unless ``text`` is written as a `MethodName` whose method is known or saved in ``planners``."""
    _find(text, planners)


def make_method(
    text: str,
    policy: DiffusionPolicy,
    *,
    num_updates: int,
    planners: Path,
    calibration: Callable[[], Calibration],
) -> DiffusionPolicy:
    """Return the policy under a method; it shares the networks with ``policy``.

    Args:
        text: the method, as the module says.
        policy: the trained policy with its own sampler.
        num_updates, planners, calibration: see `MethodInputs`. A BAC schedule that is not in ``planners``, or was made
            with another M, is computed.

    Raises:
        ValueError: for an unknown name, a planner that was made for another policy, or a rate that it does not take.

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
    method, written = _find(text, planners), MethodName.parse(text)
    inputs = MethodInputs(written.name, policy.plan.spec, policy.sampler, num_updates, planners, calibration)
    planner, sampler = method.make(inputs)
    if written.rates:
        _ask_for(planner, written)
    made = policy.with_plan(planner, sampler, method.start(inputs)).to(policy.device)
    if method.noise:
        made = made.with_noise(method.noise)
    if written.weights:
        made.engine = f"native_{written.weights}"
    return made


def make_controller(text: str) -> TensorDictModuleBase | None:
    """Return the controller of a method, of a saved one too."""
    written = MethodName.parse(text)
    return (_lookup(written.name) or SAVED).controller(written.rates)


def method_identity(text: str, policy: DiffusionPolicy) -> dict[str, Any]:
    """Return all that makes the episodes of one method its own, as JSON values for an `EpisodeLog`.

    Args:
        text: the method.
        policy: as :func:`make_method` returned it.
    """
    other_noise = {"noise": policy.noise_stream} if policy.noise_stream else {}
    start = {"start": policy.start.name} if policy.start.name else {}
    return {
        "method": text,
        "policy": policy.fingerprint,
        "engine": policy.engine,
        "sampler": policy.sampler.config,
        "planner": policy.plan.fingerprint,
        **other_noise,
        **start,
    }


def _find(text: str, planners: Path) -> Method:
    name = MethodName.parse(text).name
    if (method := _lookup(name)) is not None:
        return method
    if _saved_path(planners, name) is None:
        known = [
            *METHODS,
            *(path.stem for path in sorted(planners.glob("*")) if _saved_path(planners, path.stem)),
        ]
        raise InputError(
            f"methods: expected {', '.join(METHODS)}, or a planner in {planners} ({name}.json or {name}/), "
            f"got {text!r}{did_you_mean(name, known)}"
        )
    return SAVED


def _lookup(name: str) -> Method | None:
    matching = (
        method for method in METHODS.values() if method.pattern and re.fullmatch(method.pattern, name)
    )
    return METHODS.get(name) or next(matching, None)


def _saved_path(planners: Path, name: str) -> Path | None:
    file, folder = planners / f"{name}.json", planners / name
    if file.is_file():
        return file
    return folder if (folder / "config.json").is_file() else None


def _ask_for(planner: Planner, written: MethodName) -> None:
    """Set the rate of queries that bring none. Both rates are tried: a wrong one is found now and not in mid-episode."""
    if planner.rate is None:
        raise InputError(
            f"methods: {written.name}: expected a planner that takes a prune rate, got {type(planner).__name__}"
        )
    for rate in reversed(written.rates):
        planner.rate = rate
