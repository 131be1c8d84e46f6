"""The methods of a benchmark by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_sparse import keys
from torchrl_sparse.blocks.bac import SCHEDULES
from torchrl_sparse.blocks.calibration import Calibration
from torchrl_sparse.blocks.planner import Dense, Planner
from torchrl_sparse.blocks.sag.planner import SAGPruner
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.blocks.uniform import Uniform
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

_FEWER_STEPS = re.compile(r"ddim([1-9]\d*|(?:_\d+)+)")
METHODS = "dense, ddim<N>, ddim_<t>_<t>..., uniform, " + ", ".join(SCHEDULES)


@dataclass(frozen=True)
class MethodName:
    """A method as it is written: ``PLAN`` or ``PLAN@RATE`` or ``PLAN@COARSE-FINE``.

    Attributes:
        plan: dense, ddim<N> (at diffusers' timesteps), ddim_90_50_10 (at those), uniform, a BAC schedule, or the name of a
            planner's file or folder.
        rates: prune rates for a pruner that takes them: none, one for every query, or two, the one of coarse and the one of
            fine motion, between which an `ActionAwareController` switches.
    """

    plan: str
    rates: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> MethodName:
        """Raises ValueError unless ``text`` is written as above.

        >>> MethodName.parse("sag_rates@0.95-0.7")
        MethodName(plan='sag_rates', rates=(0.95, 0.7))
        """
        match = re.fullmatch(r"(\w+)(?:@(0?\.\d+)(?:-(0?\.\d+))?)?", text)
        if match is None:
            raise ValueError(f"methods: expected NAME, NAME@RATE or NAME@COARSE-FINE, got {text!r}")
        plan, *rates = match.groups()
        return cls(plan, tuple(float(rate) for rate in rates if rate is not None))

    def controller(self) -> ActionAwareController | None:
        """What re-plans and moves the rate while an episode runs."""
        if len(self.rates) < 2:
            return None
        coarse, fine = self.rates
        return ActionAwareController(coarse=coarse, fine=fine, budget_key=keys.PRUNE_RATE)


def check_method(name: str, plans: Path) -> None:
    """Raises ValueError unless ``name`` is one of `METHODS` or there is a file or folder of that name in ``plans``."""
    plan = MethodName.parse(name).plan
    known = plan in ("dense", "uniform", *SCHEDULES) or _FEWER_STEPS.fullmatch(plan)
    if not known and _planner_path(plans, plan) is None:
        raise ValueError(
            f"methods: expected {METHODS}, or a schedule or pruner in {plans} ({plan}.json or {plan}/), got {name!r}"
        )


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
        name: see `check_method`.
        policy: the trained policy with its own sampler.
        num_updates: M of the BAC schedules, and updates of ``uniform``.
        schedules: folder of schedules, ``<name>.json``, and pruners, ``<name>/``. A BAC schedule that is not there, or was made
            with another M, is computed.
        calibration: called where a schedule has to be computed.

    Raises:
        ValueError: for an unknown name, a planner that was made for another policy, or a rate that it does not take.
    """
    check_method(name, schedules)
    method = MethodName.parse(name)
    sampler, plan = policy.sampler, Dense()
    if _FEWER_STEPS.fullmatch(method.plan):
        sampler = _fewer_steps(method.plan, policy.sampler.num_train_timesteps)
    elif method.plan == "uniform":
        plan = Uniform(interval=-(-policy.num_inference_steps // num_updates))
    elif method.plan in SCHEDULES:
        plan = _bac(method.plan, policy, num_updates, schedules, calibration)
    elif method.plan != "dense":
        plan, sampler = _saved_planner(_planner_path(schedules, method.plan), policy)
    if method.rates:
        _set_rates(name, plan, method.rates)
    return DiffusionPolicy(
        policy.network,
        policy.normalizer,
        vision=policy.vision,
        sampler=sampler,
        plan=plan,
        engine=policy.engine,
    )


def _fewer_steps(name: str, num_train_timesteps: int) -> Sampler:
    if name.startswith("ddim_"):
        return Sampler.from_name(name, num_train_timesteps=num_train_timesteps)
    return Sampler("ddim", int(name.removeprefix("ddim")), num_train_timesteps)


def _planner_path(plans: Path, name: str) -> Path | None:
    candidates = (plans / f"{name}.json", plans / name / "config.json")
    return next((path for path in candidates if path.is_file()), None)


def _saved_planner(path: Path, policy: DiffusionPolicy) -> tuple[Planner, Sampler]:
    """A schedule or a pruner, and the sampler that it was made for."""
    if path.name == "config.json":
        planner = SAGPruner.from_pretrained(path.parent)
        sampler, num_steps = planner.info.sampler, len(planner.network.timesteps)
    else:
        planner = SchedulePlanner.from_pretrained(path)
        sampler, num_steps = planner.schedule.sampler, planner.schedule.num_inference_steps
    return planner, Sampler.from_name(sampler, num_steps, policy.sampler.num_train_timesteps)


def _set_rates(name: str, plan: Planner, rates: tuple[float, ...]) -> None:
    """Sets the rate of queries that bring none; a wrong one is found now and not in mid-episode."""
    if not isinstance(plan, SAGPruner):
        raise ValueError(f"methods: {name}: only a pruner takes a rate, got {type(plan).__name__}")
    for rate in reversed(rates):
        plan.rate = rate


def _bac(name, policy, num_updates, schedules, calibration) -> Planner:
    path = schedules / f"{name}.json"
    if path.exists():
        found = CacheSchedule.from_pretrained(path)
        if found.settings.get("num_updates") == num_updates:
            return SchedulePlanner(found)
    return SchedulePlanner(SCHEDULES[name](calibration(), num_updates, policy=policy.fingerprint))


def method_identity(name: str, policy: DiffusionPolicy) -> dict[str, Any]:
    """What makes the episodes of one method its own, as JSON values for an `EpisodeLog`."""
    return {
        "method": name,
        "policy": policy.fingerprint,
        "engine": policy.engine,
        "sampler": policy.sampler.config,
        "planner": policy.plan.fingerprint,
    }
