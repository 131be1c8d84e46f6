"""Output of an acceleration: a ready-to-use policy, its card, a film and a report."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import torch
from torchrl.envs import EnvBase

from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.benchmarks.film import film_masks
from torchrl_sparse.evaluation.figures.acceleration import plot_acceleration
from torchrl_sparse.evaluation.figures.html_report import write_report
from torchrl_sparse.evaluation.results.acceleration import (
    Acceleration,
    acceleration_note,
    acceleration_rows,
    verdict_line,
)
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["film_chosen", "save_policy", "write_acceleration_report"]

_CARD = """# {task}, accelerated: {chosen}

{verdict}

```python
from torchrl_sparse import ChunkExecutor, DiffusionPolicy

policy = DiffusionPolicy.from_pretrained("{folder}")  # its sampler and planner are installed
actor = ChunkExecutor(policy, n_action_steps={n_action_steps})
```

The weights are those of the policy with the fingerprint `{policy}`; nothing was trained on them. `acceleration.json` holds
the numbers below.

![error to demonstrations against latency](acceleration.png)

{table}

{note}
"""


def save_policy(found: Acceleration, policy: DiffusionPolicy, folder: Path, *, n_action_steps: int) -> None:
    """Write the chosen policy and its card into ``folder`` atomically: the old content stays until all is written.

    Weights are stored in half precision only where that loses nothing, so that the saved policy answers as the one measured.

    Args:
        found: what was measured.
        policy: under the chosen method.
        folder: for `DiffusionPolicy.from_pretrained`.
        n_action_steps: actions executed of a chunk, for the card.
    """
    made, old = (folder.with_name(f".{folder.name}.{word}") for word in ("tmp", "old"))
    for path in (made, old):  # of a run that was killed
        shutil.rmtree(path, ignore_errors=True)
    policy.save_pretrained(made, half=_fits_half(policy))
    plot_acceleration(found, made / "acceleration.png")
    (made / "README.md").write_text(_card(found, folder, n_action_steps), encoding="utf-8")
    if folder.exists():
        os.replace(folder, old)
    os.replace(made, folder)
    shutil.rmtree(old, ignore_errors=True)


def film_chosen(
    found: Acceleration,
    policy: DiffusionPolicy,
    make_env: Callable[..., EnvBase],
    out: Path,
    *,
    n_action_steps: int,
    seed: int,
) -> None:
    """Film the first episode of the chosen method as ``OUT/rollout_METHOD.mp4``, unless the film exists.

    Raises:
        RuntimeError: without a GL library.
    """
    if (out / f"rollout_{found.chosen}.mp4").exists():
        return
    first = evaluation_seeds("development", seed, 1)[0]
    film_masks(
        found.chosen, ChunkExecutor(policy, n_action_steps), make_env, first, out, found.machine.threads
    )


def write_acceleration_report(found: Acceleration, out: Path) -> Path:
    """Write ``OUT/report.html`` with verdict, Pareto front, played methods and films; return its path."""
    path = out / "report.html"
    faults = write_report(out, path, title=f"{found.task}: {verdict_line(found)}")
    if faults:
        raise InputError("; ".join(f"{out / name}: {fault}" for name, fault in faults.items()))
    return path


def _card(found: Acceleration, folder: Path, n_action_steps: int) -> str:
    return _CARD.format(
        task=found.task,
        chosen=found.chosen,
        verdict=verdict_line(found),
        folder=folder.as_posix(),
        n_action_steps=n_action_steps,
        policy=found.policy,
        table=markdown_table(acceleration_rows(found)),
        note=acceleration_note(found),
    )


def _fits_half(policy: DiffusionPolicy) -> bool:
    weights = policy.network.state_dict().values()
    return all(torch.equal(weight, weight.half().to(weight.dtype)) for weight in weights)
