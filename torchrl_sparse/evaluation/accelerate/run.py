"""The stages of an acceleration in order: calibrate, time, rank, play, choose, save.

Every stage leaves a file, which an interrupted run reads instead of making it again::

    OUT/planners/                cache schedules, a pruner if one is trained, and searches/ for timesteps
    OUT/errors.json              of every candidate, to demonstrations
    OUT/timings.json             of every candidate, interleaved on this machine
    OUT/episodes/NAME.jsonl      of the finalists and of dense, on the same seeds
    OUT/results.json             the finalists as a benchmark of its own; where episodes were played
    OUT/acceleration.json        all of it, and what was chosen
    OUT/policy/                  the policy with its sampler and planner, and its card
    OUT/report.html              the front, the verdict, the video
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sparse import keys
from torchrl_sparse.control.queries import answer
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.envs.contract import provenance
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.accelerate.candidates import Grid, calibrate_candidates, family
from torchrl_sparse.evaluation.accelerate.choice import choose, rank, within_budget
from torchrl_sparse.evaluation.accelerate.finalists import Finalists
from torchrl_sparse.evaluation.accelerate.pruner import train_candidate
from torchrl_sparse.evaluation.accelerate.request import Request
from torchrl_sparse.evaluation.accelerate.stages import Errors, Timings, read_or_make
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods
from torchrl_sparse.evaluation.latency.measure import Latency, Machine, describe_machine
from torchrl_sparse.evaluation.latency.queries import time_queries
from torchrl_sparse.evaluation.results.acceleration import (
    Acceleration,
    Candidate,
    Played,
)
from torchrl_sparse.evaluation.results.parts import Percentiles
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.diffusion.timesteps import planned_error
from torchrl_sparse.training.pruner.config import PrunerConfig

__all__ = ["accelerate"]


def accelerate(
    policy: DiffusionPolicy,
    demos: Demonstrations,
    out: Path,
    request: Request,
    *,
    make_env: Callable[..., EnvBase],
    made_for: Mapping[str, Any],
    grid: Grid = Grid(),  # noqa: B008, it is frozen
    pruner: PrunerConfig | None = None,
) -> tuple[Acceleration, dict[str, DiffusionPolicy]]:
    """Find the fastest method that is non-inferior to the dense policy, and write ``acceleration.json`` with all evidence.

    Args:
        policy: the trained policy with its own sampler, observing states.
        demos: of the task.
        out: folder; what an earlier call of the same policy and demonstrations left there is gone on with.
        request: what is asked for.
        make_env: called as ``make_env(seeds=[...])`` where episodes are asked for, see `diffusion_env`.
        made_for: names the demonstrations, JSON values; what ``out`` holds of others is refused.
        grid: the candidates.
        pruner: how to train a pruner as a further candidate; None trains nothing.

    Returns:
        What was found, and the policy under every method.

    Raises:
        InputError: naming the option or the file, if the policy has a planner, nothing keeps the budget, or ``out``
            holds something else.

    Examples:
        >>> from torchrl_sparse.envs.for_policy import diffusion_env
        >>> from torchrl_sparse.data.for_policy import policy_demos
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> demos = policy_demos("lift.hdf5", "lift", policy)  # doctest: +SKIP
        >>> request = Request("lift", budget_ms=5)
        >>> options = {"make_env": diffusion_env("lift", policy), "made_for": {"demos": "lift.hdf5"}}
        >>> found, _ = accelerate(policy, demos, Path("fast"), request, **options)  # doctest: +SKIP
        >>> found.chosen  # doctest: +SKIP
        'ddpm3_logsnr'
    """
    _check_policy(policy)
    made_for = {
        "policy": policy.fingerprint,
        **policy.sampler.config,
        **provenance(demos.contract),
        **made_for,
    }
    made_for |= {"demonstrations": len(demos), "steps": len(demos.data)}
    made_for |= {name: getattr(request, name) for name in ("windows", "seed", "n_action_steps")}
    targets, queries = _from_demonstrations(policy, demos, request)
    planners = out / "planners"
    n_action_steps = request.n_action_steps
    names = calibrate_candidates(
        policy, targets, grid, planners, made_for=made_for, n_action_steps=n_action_steps
    )
    if pruner is not None:
        options = {"made_for": made_for, "n_action_steps": n_action_steps}
        names.append(train_candidate(policy, demos, pruner, out / "training", planners, **options))
    methods = make_methods(
        names, policy, num_updates=policy.num_inference_steps, planners=planners, calibration=_no_calibration
    )
    errors = _measure_errors(methods, targets, out, made_for, request)
    machine, timings = _time(methods, queries, out, made_for, request)
    candidates = {
        name: Candidate(family(method, policy.sampler), errors[name], Percentiles.of(timings[name]))
        for name, method in methods.items()
    }
    fast = within_budget(candidates, request.budget_ms)
    ranking = rank(fast, candidates, request.budget_ms)
    played: dict[str, Played] = {}
    if request.episodes:
        finalists = {name: methods[name] for name in [DENSE, *ranking[: request.finalists]]}
        measured = {"machine": machine, "timings": timings, "queries": answer(policy, queries)}
        results = Finalists(request, finalists, make_env, out, **measured).run()
        played = {name: Played.of(entry) for name, entry in results.methods.items()}
    found = Acceleration(
        1,
        find_task(request.task).name,
        policy.fingerprint,
        len(targets),
        machine,
        candidates,
        ranking,
        choose(ranking, candidates, played, request.budget_ms),
        played,
        request.budget_ms,
    )
    write_json(out / "acceleration.json", found)
    return found, methods


def _check_policy(policy: DiffusionPolicy) -> None:
    if policy.plan.fingerprint != policy.with_plan(None).plan.fingerprint:
        raise InputError(
            f"policy: expected one that nothing is pruned of yet, got {type(policy.plan).__name__}"
        )


def _no_calibration() -> Any:
    raise AssertionError("every schedule was calibrated before")


def _from_demonstrations(
    policy: DiffusionPolicy, demos: Demonstrations, request: Request
) -> tuple[TensorDict, TensorDict]:
    """Return targets of some windows of the demonstrations, and policy calls with what is observed in them."""
    rows = demos.window_rows(policy.horizon, policy.n_obs_steps, request.n_action_steps)
    targets = make_targets(
        policy,
        demos,
        share=min(1.0, request.windows / len(rows)),
        source="data",
        n_action_steps=request.n_action_steps,
        seed=request.seed,
    )
    spread = torch.linspace(0, len(rows) - 1, min(request.repeats, len(rows))).long()
    queries = demos.windows(rows[spread], policy.n_obs_steps).exclude(keys.ACTION)
    index = torch.arange(len(spread))[:, None]
    queries.update({keys.EPISODE_SEED: torch.full_like(index, request.seed), keys.EPISODE_STEP: index})
    return targets, queries.to(policy.device)


def _measure_errors(
    methods: Mapping[str, DiffusionPolicy],
    targets: TensorDict,
    out: Path,
    made_for: dict[str, Any],
    request: Request,
) -> dict[str, float]:
    settings = {**made_for, "planners": {name: method.plan.fingerprint for name, method in methods.items()}}

    def make() -> Errors:
        bar = tqdm(methods.items(), desc=f"{'errors':>14}", unit="method")
        errors = {
            name: planned_error(method, targets, n_action_steps=request.n_action_steps)
            for name, method in bar
        }
        return Errors("torchrl_sparse.errors/1", settings, errors)

    return read_or_make(out / "errors.json", Errors, settings, make, remake=True).errors


def _time(
    methods: Mapping[str, DiffusionPolicy],
    queries: TensorDict,
    out: Path,
    made_for: dict[str, Any],
    request: Request,
) -> tuple[Machine, dict[str, Latency]]:
    """Time all methods, unless they were timed on this machine; on another they are timed again."""
    machine = describe_machine(methods[DENSE].device, request.threads)
    settings = {
        **made_for,
        "planners": {name: method.plan.fingerprint for name, method in methods.items()},
        "engine": methods[DENSE].engine_info(),
        "repeats": request.repeats,
        "cpu": machine.cpu,
        "device": machine.device,
        "threads": machine.threads,
        "torch": machine.torch,
    }

    def make() -> Timings:
        with progress("latency", "round", request.repeats) as show:
            timings = time_queries(
                methods, queries, repeats=request.repeats, threads=request.threads, on_round=show
            )
        return Timings("torchrl_sparse.timings/1", settings, machine, timings)

    found = read_or_make(out / "timings.json", Timings, settings, make, remake=True)
    return found.machine, found.timings
