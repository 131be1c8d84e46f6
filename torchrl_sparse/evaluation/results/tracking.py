"""Logging of benchmarks to Weights & Biases: numbers under fixed names; tables, pictures and videos as media."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_sparse.evaluation.results.report import results_rows
from torchrl_sparse.evaluation.results.schema import MethodEntry, Results
from torchrl_sparse.runtime.wandb_run import wandb_arguments

__all__ = ["log_benchmark", "tested_method", "trial_metrics"]


def tested_method(results: Results) -> str:
    """Return the name of the method that a sweep trial tests: the last one."""
    return list(results.methods)[-1]


def trial_metrics(results: Results) -> dict[str, float]:
    """Return ``"<method>/<number>"`` for every method, and ``"tested/<number>"`` for the last one, under any name."""
    named = {**results.methods, "tested": results.methods[tested_method(results)]}
    return {
        f"{name}/{key}": value for name, method in named.items() for key, value in _numbers(method).items()
    }


def _numbers(method: MethodEntry) -> dict[str, float]:
    return {
        "success": method.success.rate,
        "diff_to_dense": method.paired_vs_dense.diff,
        "prune_rate": method.prune_rate,
        "flops_ratio": method.flops.ratio_to_dense,
        "latency_p50_s": method.latency_s.p50,
        "speedup": method.speedup_vs_dense,
        "action_error": method.action_error_vs_dense.mean,
        "episode_length": method.episode_length,
    }


def log_benchmark(results: Results, folder: Path, config: Mapping[str, Any]) -> None:
    """Log a finished benchmark as one run; logging it again updates the same run; see `wandb_arguments`.

    Args:
        results: of the benchmark.
        folder: where its pictures and videos are.
        config: its settings.
    """
    import wandb

    name = f"{results.task} {', '.join(list(results.methods)[1:])}"
    with wandb.init(**wandb_arguments(config, folder, name)) as run:
        rows = results_rows(results)
        media: dict[str, Any] = {
            "table": wandb.Table(columns=list(rows[0]), data=[list(row.values()) for row in rows])
        }
        media |= {f"figures/{path.stem}": wandb.Image(str(path)) for path in sorted(folder.glob("*.png"))}
        media |= {f"videos/{path.stem}": wandb.Video(str(path)) for path in sorted(folder.glob("*.mp4"))}
        run.log({**trial_metrics(results), **media})
