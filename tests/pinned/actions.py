"""What every shipped method answers to a few fixed policy calls."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tests.pinned import build

ASSETS = Path(__file__).parents[2] / "assets"
STORED = Path(__file__).with_name("actions.safetensors")
ENGINES = ("native", "torch")
# All shipped planners reuse by "block", so copies of two of lift's stand for the other rules.
_COPIED = {"bac": "bac.json", "sag": "sag/config.json"}
_RULES = ("type", "single")
# Of dense's hundred steps, which take longest, with other noise or another sampler: pinned once for each size.
_AS_DENSE = {"dense_noise", "ddim100"}
_OBSERVATIONS = json.loads(Path(__file__).with_name("observations.json").read_text(encoding="utf-8"))
# One policy of each size; that engines agree is tested where engines are.
_IN_TORCH = {"lift", "pusht", "lift_image"}
# Not of the policy's planner; and what rounded weights answer depends on the instruction set.
_EXECUTED_OR_ROUNDED = re.compile(r"_every\d|_of\d|:")
# Rows of tables alone: methods that reused features of earlier policy calls.
_REMOVED = re.compile(r"recall\d+|recalling|tts(_fixed)?")
# Results alone: of other training seeds, of a policy that knows four ways, of one of less training, of what another began from.
_WITHOUT_WEIGHTS = (
    "lift/seeds",
    "lift_two_ways/seeds",
    "lift_two_ways/four",
    "pusht/shorter",
    "square/weaker",
)
_INSTRUCTION, _KEPT = "lift the green cube", 50.0


@dataclass(frozen=True)
class Case:
    """One method of one policy, in one engine where the policy has engines, and perhaps under another rule of reuse."""

    asset: str
    method: str
    engine: str = ""
    reuse: str = ""

    def __str__(self) -> str:
        return "/".join(filter(None, (self.asset, self.method, self.reuse, self.engine)))

    @property
    def rounding(self) -> int:
        """Blocks, in all masks together, that rounding may decide: a pruner compares numbers that may be nearly equal."""
        return 2 if (ASSETS / self.asset / self.method.partition("@")[0]).is_dir() else 0

    @property
    def tolerance(self) -> float:
        """In normalised units, in which actions span [-1, 1]. Scalar code and AVX-512 were seen to differ by 3e-6, engines by
        9e-6; features of cameras, which a convolution of another machine may sum in another order, by 1e-5 of themselves."""
        return 1e-3 if has_cameras(ASSETS / self.asset) else 2e-5

    def answer(self) -> dict[str, Tensor]:
        """Normalised chunk [Q, n, A], mask [Q, ...] and FLOPs [Q, 1] of the Q policy calls."""
        torch.manual_seed(0)
        return _vla_answers(self) if is_vla(ASSETS / self.asset) else _diffusion_answers(self)


def cases() -> Iterator[Case]:
    """All of what is shipped, and copies under other rules of reuse."""
    for folder in policies():
        for method in shipped_methods(folder):
            if method in _AS_DENSE and folder.name not in _IN_TORCH:
                continue
            for engine in ("",) if is_vla(folder) else engines_of(folder, method):
                yield Case(str(folder.relative_to(ASSETS)), method, engine)
    for method, rule, engine in product(_COPIED, _RULES, ENGINES):
        yield Case("lift", method, engine, rule)


def policies() -> list[Path]:
    """The folders of all policies; one that is trained again may lie in that of another."""
    return sorted(path.parent for path in ASSETS.rglob("model.safetensors"))


def policy_of(folder: Path) -> Path:
    """The folder of the policy that results or episodes in ``folder`` are of: the nearest that has one."""
    return next(path for path in (folder, *folder.parents) if (path / "model.safetensors").exists())


def is_kept(folder: Path) -> bool:
    """Whether results or episodes in ``folder`` are of a policy whose weights are here."""
    return not any(folder.is_relative_to(ASSETS / results) for results in _WITHOUT_WEIGHTS)


def is_removed(method: str) -> bool:
    """Whether results and episodes are all that is left of a method."""
    return _REMOVED.match(method) is not None


def engines_of(folder: Path, method: str) -> tuple[str, ...]:
    """The engines that a method is asked in: not PyTorch's where it is much as another case is."""
    if method in _AS_DENSE or folder.name not in _IN_TORCH:
        return ("native",)
    return ENGINES


def shipped_methods(folder: Path) -> list[str]:
    """Dense, uniform, the planners beside the policy, and what its tables name."""
    tables = [*folder.rglob("results*.json"), *folder.glob("realtime.json")]
    tables = [table for table in tables if is_kept(table.parent) and policy_of(table.parent) == folder]
    named = {name for table in tables for name in json.loads(table.read_text(encoding="utf-8"))["methods"]}
    named = {name for name in named if not _EXECUTED_OR_ROUNDED.search(name) and not is_removed(name)}
    files = {path for path in folder.glob("*.json") if path.name != "config.json"} - {*tables}
    if is_vla(folder):
        return sorted(named | {path.name for path in files})
    pruners = {path.parent.name for path in folder.glob("*/pruner.safetensors")}
    return sorted({"dense", "uniform"} | named | pruners | {path.stem for path in files})


def _diffusion_answers(case: Case) -> dict[str, Tensor]:
    """The first policy call on its own, the others as a batch: engines have a way for each."""
    folder = ASSETS / case.asset
    first, *others = _diffusion_queries(folder)
    with tempfile.TemporaryDirectory() as copies:
        planners = _reusing(folder, Path(copies), case.reuse) if case.reuse else folder
        actor = build.diffusion_actor(folder, planners, case.method, case.engine)
    answers = [build.diffusion_answer(actor, query) for query in (first[None], torch.stack(others))]
    return {name: torch.cat([answer[name] for answer in answers]) for name in answers[0]}


def _diffusion_queries(folder: Path) -> list:
    """What was observed in the task; one with cameras, which has none of its own, gets Lift's arm and patterns."""
    if not has_cameras(folder):
        return [build.diffusion_query(**observation) for observation in _OBSERVATIONS[_task_of(folder)]]
    before, after = _images()
    return [
        build.diffusion_query(
            **{**observation, "state": [state[10:] for state in observation["state"]]}, images=images
        )
        for observation, images in zip(_OBSERVATIONS["lift"], (before, before, after), strict=True)
    ]


def _task_of(folder: Path) -> str:
    return folder.relative_to(ASSETS).parts[0]


def has_cameras(folder: Path) -> bool:
    return "vision" in _config(folder)


def is_vla(folder: Path) -> bool:
    return "vla_policy" in _config(folder)["format"]


def _config(folder: Path) -> dict:
    return json.loads((folder / "config.json").read_text(encoding="utf-8"))


def _reusing(folder: Path, copies: Path, rule: str) -> Path:
    """Copies of planners that reuse by ``rule``."""
    shutil.copytree(
        folder, copies, ignore=shutil.ignore_patterns("model.*", "episodes", "figures"), dirs_exist_ok=True
    )
    for name in _COPIED.values():
        content = json.loads((folder / name).read_text(encoding="utf-8"))
        (copies / name).write_text(json.dumps({**content, "reuse": rule}), encoding="utf-8")
    return copies


def _vla_answers(case: Case) -> dict[str, Tensor]:
    """Two policy calls of an episode, the second in the knowledge of the first."""
    actor = build.vla_actor(ASSETS / case.asset, case.method, _vla_queries(), _KEPT)
    answers, last = [], None
    for query in _vla_queries():
        answers.append(build.vla_answer(actor, query, last))
        last = query
    return {name: torch.stack([answer[name] for answer in answers]) for name in answers[0]}


def _vla_queries() -> list:
    lift = _OBSERVATIONS["lift"]
    return [
        build.vla_query(
            images,
            state=observation["state"][-1][10:],
            instruction=_INSTRUCTION,
            eef_vel=observation["eef_vel"],
            seed=observation["seed"],
            step=observation["step"],
        )
        for images, observation in zip(_images(), (lift[0], lift[2]), strict=True)
    ]


@cache
def _images() -> list[Tensor]:
    """Coarse patterns of two cameras, u8 [2, 3, 84, 84], and the same with more and more change towards one corner."""
    generator = np.random.default_rng(0)
    coarse = generator.integers(40, 216, (2, 3, 12, 12)).repeat(7, axis=2).repeat(7, axis=3)
    ramp = np.linspace(0, 1, 84)
    change = generator.integers(-40, 41, coarse.shape) * ramp * ramp[:, None]
    before = coarse + generator.integers(-5, 6, coarse.shape)
    after = before + generator.integers(-1, 2, coarse.shape) + change
    return [torch.from_numpy(images.clip(0, 255).astype(np.uint8)) for images in (before, after)]
