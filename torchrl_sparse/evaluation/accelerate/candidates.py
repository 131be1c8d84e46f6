"""Candidate methods of an acceleration, and their calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args

from tensordict import TensorDict
from tqdm import tqdm

from torchrl_sparse import keys
from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import Calibration, calibrate
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.planner import Dense
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.accelerate.stages import Search, read_or_make
from torchrl_sparse.evaluation.results.acceleration import Family
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.methods.spec import WEIGHTS
from torchrl_sparse.networks.diffusion.naming import SamplerName
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.diffusion import RoundedEngine
from torchrl_sparse.training.diffusion.timesteps import find_timesteps

__all__ = ["Grid", "calibrate_candidates", "family"]

_TOP_K = 5  # blocks that BAC's bubbling union enlarges; the paper's


@dataclass(frozen=True)
class Grid:
    """Grid of candidate methods, none of which needs training.

    Attributes:
        samplers: chains by name, see `torchrl_sparse.networks.diffusion.naming`.
        searched: chains as KIND and STEPS, such as ``"ddpm3"``, whose timesteps demonstrations decide.
        cached: chains that cache schedules are made for, beside the policy's own.
        updates: M, how often BAC computes a block; of each chain those below its steps.
        intervals: of uniform caching; of each chain those below its steps.
        rounded: weights, ``"int8"`` or ``"bf16"``, that dense and every chain without a cache are tried with too, where the
            native engine runs.
        strides: of the search, see `search_timesteps`.

    Raises:
        InputError: naming the field, for a name that is no sampler or has no steps.
    """

    samplers: tuple[str, ...] = (
        *("ddpm2_logsnr", "ddpm3_logsnr", "ddpm5_logsnr", "ddpm10_logsnr"),
        *("ddim2_logsnr", "ddim3_logsnr", "ddim5", "ddim10", "ddim20"),
    )
    searched: tuple[str, ...] = ("ddpm2", "ddpm3", "ddim2", "ddim3")
    cached: tuple[str, ...] = ("ddpm10_logsnr", "ddim10")
    updates: tuple[int, ...] = (3, 5, 10, 20)
    intervals: tuple[int, ...] = (2, 4, 7)
    rounded: tuple[str, ...] = ("int8",)
    strides: tuple[int, ...] = (10, 5, 2)

    def __post_init__(self) -> None:
        for field in ("samplers", "searched", "cached"):
            for name in getattr(self, field):
                _check_chain(field, name)
        for name in self.searched:
            if SamplerName.parse(name).timesteps is not None:
                raise InputError(f"searched: expected KIND and STEPS, such as ddpm3, got {name!r}")
        for weights in self.rounded:
            if weights not in WEIGHTS:
                raise InputError(f"rounded: expected some of {', '.join(WEIGHTS)}, got {weights!r}")


def calibrate_candidates(
    policy: DiffusionPolicy,
    targets: TensorDict,
    grid: Grid,
    folder: Path,
    *,
    made_for: dict[str, Any],
    n_action_steps: int = 8,
) -> list[str]:
    """Calibrate all candidates and return the names by which a benchmark finds them, with ``planners=FOLDER``.

    What is in the folder already, of an earlier call, is not made again.

    Args:
        policy: the trained policy with its own sampler.
        targets: [N], from data, see `make_targets`; BAC is calibrated on the first of them.
        grid: what is tried.
        folder: of the schedules, and under ``searches`` of the searches for timesteps.
        made_for: what searches depend on beside their own settings; JSON values.
        n_action_steps: actions executed of a chunk.

    Raises:
        InputError: naming the file, if one in the folder was made for something else; or the grid's field, if a chain in
            it has more steps than the policy was trained with.
    """
    _check_fits(policy, grid)
    names = list(grid.samplers)
    bar = tqdm(grid.searched, desc=f"{'timesteps':>14}", unit="search")
    for chain in bar:
        names.append(_search(policy, targets, chain, grid, folder, made_for, n_action_steps, bar.refresh))
    if native_supports(policy.network)[0]:
        names += [f"{name}:{weights}" for weights in grid.rounded for name in (DENSE, *names)]
    for chain in tqdm([None, *grid.cached], desc=f"{'schedules':>14}", unit="chain"):
        names += _cache_schedules(policy, targets, chain, grid, folder)
    return list(dict.fromkeys(names))


def family(policy: DiffusionPolicy, own: Sampler) -> Family:
    """Return the family of a candidate method, compared with the dense policy's ``own`` sampler.

    >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
    >>> [family(policy.with_plan(None, Sampler(kind, 3)), policy.sampler) for kind in ("ddpm", "ddim")]
    ['stochastic', 'deterministic']
    """
    if not policy.plan.is_static:
        return "pruner"
    if not isinstance(policy.plan, Dense):
        return "cached"
    if policy.engine in get_args(RoundedEngine) and policy.sampler.config == own.config:
        return "rounded"
    draws = any(policy.sampler.coefficients.reads_noise(k) for k in range(policy.num_inference_steps))
    return "stochastic" if draws else "deterministic"


def _check_chain(field: str, name: str) -> None:
    try:
        parts = SamplerName.parse(name)
    except ValueError as error:
        raise InputError(f"{field}: {error}") from error
    if parts.num_inference_steps is None and parts.timesteps is None:
        raise InputError(f"{field}: expected a sampler with its steps, such as ddpm3, got {name!r}")


def _check_fits(policy: DiffusionPolicy, grid: Grid) -> None:
    """Refuse chains that the policy cannot take, before anything is calibrated."""
    for field in ("samplers", "searched", "cached"):
        for name in getattr(grid, field):
            try:
                _sampler(policy, name)
            except ValueError as error:
                raise InputError(f"{field}: {name}: {error}") from error


def _sampler(policy: DiffusionPolicy, name: str) -> Sampler:
    return policy.sampler.variant_named(name)


def _search(
    policy: DiffusionPolicy,
    targets: TensorDict,
    chain: str,
    grid: Grid,
    folder: Path,
    made_for: dict[str, Any],
    n_action_steps: int,
    on_chain: Callable[[], object],
) -> str:
    asked, settings = SamplerName.parse(chain), {**made_for, "strides": list(grid.strides)}

    def make() -> Search:
        found = find_timesteps(
            policy,
            targets,
            asked.kind,
            asked.num_inference_steps,
            eta=asked.eta,
            strides=grid.strides,
            n_action_steps=n_action_steps,
            on_chain=on_chain,
        )
        return Search("torchrl_sparse.search/1", settings, found.sampler.name, found.error, len(found.tried))

    return read_or_make(folder / "searches" / f"{chain}.json", Search, settings, make).method


def _cache_schedules(
    policy: DiffusionPolicy, targets: TensorDict, chain: str | None, grid: Grid, folder: Path
) -> Iterator[str]:
    """Yield the methods that cache one chain, the policy's own if None; make the BAC schedules that are not there."""
    sampler = policy.sampler if chain is None else _sampler(policy, chain)
    suffix = "" if chain is None else f"_{chain}"

    @cache
    def calibration() -> Calibration:
        query = targets[:1]
        noise = policy.with_plan(None, sampler).sample_noise(query[keys.SEED].squeeze(-1))
        return calibrate(policy.network, sampler, noise, query[keys.COND])

    for interval in grid.intervals:
        if interval < sampler.num_inference_steps:
            yield f"uniform{interval}{suffix}"
    for updates in grid.updates:
        if updates >= sampler.num_inference_steps:
            continue
        name = f"bac{updates}{suffix}"
        path = folder / f"{name}.json"
        if path.exists():
            _check_made_for(path, policy.with_plan(None, sampler))
        else:
            top_k = min(_TOP_K, policy.num_blocks)
            made = bac_schedule(calibration(), updates, policy=policy.fingerprint, top_k=top_k)
            made.save_pretrained(path)
        yield name


def _check_made_for(path: Path, policy: DiffusionPolicy) -> None:
    CacheSchedule.from_pretrained(path).spec.check_is(policy.plan.spec, str(path))
