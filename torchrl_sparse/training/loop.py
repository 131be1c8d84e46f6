"""The training loop of a `Trainer`: steps until the end or a signal, with logging, checkpoints and evaluations."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, get_logger
from tqdm import tqdm

from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.disk import naming_full_disk
from torchrl_sparse.runtime.interrupt import StopSignal
from torchrl_sparse.runtime.wandb_run import wandb_arguments
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.training.trainer import Trainer

__all__ = ["CHECKPOINT", "train"]

CHECKPOINT = "checkpoint.pt"
LOG = "log"


def train(
    trainer: Trainer,
    settings: Mapping[str, Any],
    *,
    export: Callable[[], Path],
    evaluate: Callable[[], float | None] | None = None,
) -> None:
    """Train until ``trainer.total`` or a stop signal, resuming from ``out/checkpoint.pt`` if it exists; save at the end.

    A training that had ended is extended by one that asks for more steps, see `Trainer.load`.

    Args:
        trainer: what to train.
        settings: of the recipe, all of which W&B is given. Read here: ``out``, the folder; ``logger``, "csv",
            under ``out/log``, or "wandb", see `wandb_arguments`; ``log_every``, ``checkpoint_every`` and, with ``evaluate``,
            ``eval_every``, steps between two of each (``eval_every`` 0: none).
        export: write what was trained so far, for its users; return where. Called with each checkpoint.
        evaluate: return the success rate so far, in [0, 1], or None where it cannot be measured.

    Logged are, over the steps since the last entry, the means of ``train/<name>`` of `Trainer.train_step` and, over those of
    them since the start or resumption, ``train/seconds_per_step``; further ``train/lr``, and ``held_out/<name>`` of
    `Trainer.validate` and ``eval/success``. A CSV log has each step once: its lines on steps after the checkpoint, which are
    run again, are removed first.

    Raises:
        InputError: if the checkpoint belongs to another training, see `Trainer.load`.
    """
    checkpoint = Path(settings["out"]) / CHECKPOINT
    if checkpoint.exists():
        trainer.load(checkpoint)
        print(f"{checkpoint}: resumed from step {trainer.step}")
    eval_every = settings["eval_every"] if evaluate else 0
    folder = Path(settings["out"]).resolve() / LOG
    _forget_after(trainer.step, folder)
    logger, since, first = _make_logger(settings), time.perf_counter(), trainer.step

    def log(metrics: Mapping[str, float], group: str) -> None:
        with naming_full_disk(folder):
            logger.log_metrics(
                {f"{group}/{name}": value for name, value in metrics.items()}, step=trainer.step
            )

    with (
        StopSignal() as stop,
        tqdm(total=trainer.total, initial=trainer.step, unit="step", mininterval=2) as bar,
    ):
        while trainer.step < trainer.total and stop.name is None:
            trainer.unlogged.append(trainer.train_step())
            bar.update()
            if trainer.step % settings["log_every"] == 0:
                now, means = time.perf_counter(), _means(trainer.unlogged)
                means |= {"lr": trainer.lr, "seconds_per_step": (now - since) / (trainer.step - first)}
                bar.set_postfix(loss=f"{means['loss']:.4f}")
                log(means, "train")
                trainer.unlogged, since, first = [], now, trainer.step
            due = trainer.step % settings["checkpoint_every"] == 0
            if due:
                log(trainer.validate(), "held_out")
            if eval_every and trainer.step % eval_every == 0 and (rate := evaluate()) is not None:
                tqdm.write(f"step {trainer.step}: success rate {rate:.2f}")
                log({"success": rate}, "eval")
            if due:  # last, so that a checkpoint's own step is in the log
                trainer.save(checkpoint)
                export()
        trainer.save(checkpoint)
        path = export()
    how = f"stopped by {stop.name}, run again to resume" if stop.name else "finished"
    print(f"{path}: step {trainer.step} of {trainer.total}, {how}")


def _means(losses: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: sum(step[name] for step in losses) / len(losses) for name in losses[0]}


def _make_logger(settings: Mapping[str, Any]) -> Logger:
    out, kind = Path(settings["out"]).resolve(), settings["logger"]
    name = f"{settings.get('task', out.name)} {settings.get('method', 'policy')}"
    wandb = wandb_arguments(settings, out, name) if kind == "wandb" else {}
    return get_logger(kind, str(out), LOG, wandb_kwargs=wandb)


def _forget_after(step: int, folder: Path) -> None:
    """Remove from a CSV log the lines after ``step``, and a partial line left by a kill."""
    for path in folder.glob("scalars/**/*.csv"):
        lines = path.read_bytes().splitlines(keepends=True)
        kept = [line for line in lines if line.endswith(b"\n") and _step_of(line, path) <= step]
        if kept != lines:
            with atomic_path(path) as temporary:
                temporary.write_bytes(b"".join(kept))


def _step_of(line: bytes, path: Path) -> int:
    try:
        return int(line.split(b",")[0])
    except ValueError as error:
        raise InputError(f"{path}: expected lines of step and value, got {line!r}") from error
