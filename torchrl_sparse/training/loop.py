"""The loop around a `Trainer`: steps until the end or a signal, with log, checkpoints and evaluations on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, get_logger
from tqdm import tqdm

from torchrl_sparse.runtime.interrupt import StopSignal
from torchrl_sparse.training.trainer import Trainer

__all__ = ["make_logger", "train"]


def train(
    trainer: Trainer,
    settings: Mapping[str, Any],
    *,
    save: Callable[[], None],
    evaluate: Callable[[], float | None],
) -> None:
    """Goes on from ``out/checkpoint.pt`` if it is there, and steps until ``max_steps`` or a signal to stop; saves at the end.

    Args:
        trainer: what to train.
        settings: of the recipe, all of which W&B is given. Read here: ``out``, the folder; ``logger`` and ``wandb_mode``, see
            `make_logger`, which gets ``train/loss``, ``train/lr``, ``train/seconds_per_step``, ``val/loss`` and
            ``eval/success``; ``log_every``, ``checkpoint_every`` and ``eval_every``, steps between two of each (0: none).
        save: writes ``out/checkpoint.pt`` and ``out/policy``.
        evaluate: the success rate of the policy so far, in [0, 1]; None where it cannot be measured.

    Raises:
        ValueError: if the checkpoint belongs to another training, see `Trainer.load`.
    """
    out = Path(settings["out"])
    if (out / "checkpoint.pt").exists():
        trainer.load(out / "checkpoint.pt")
        print(f"{out / 'checkpoint.pt'}: going on from step {trainer.step}")
    logger = make_logger(settings["logger"], out, settings=settings, wandb_mode=settings["wandb_mode"])
    stop = StopSignal()
    log_every, checkpoint_every, eval_every = (
        settings[f"{name}_every"] for name in ("log", "checkpoint", "eval")
    )
    total, losses, last = trainer.config.max_steps, [], time.perf_counter()
    with tqdm(total=total, initial=trainer.step, unit="step", mininterval=2) as bar:
        while trainer.step < total and stop.name is None:
            losses.append(trainer.train_step())
            bar.update()
            if trainer.step % log_every == 0:
                now = time.perf_counter()
                metrics = {"train/loss": sum(losses) / len(losses), "train/lr": trainer.lr}
                metrics["train/seconds_per_step"] = (now - last) / len(losses)
                bar.set_postfix(loss=f"{metrics['train/loss']:.4f}")
                logger.log_metrics(metrics, step=trainer.step)
                losses, last = [], now
            if trainer.step % checkpoint_every == 0:
                save()
                logger.log_metrics({"val/loss": trainer.validate()}, step=trainer.step)
            if eval_every and trainer.step % eval_every == 0 and (rate := evaluate()) is not None:
                tqdm.write(f"step {trainer.step}: success rate {rate:.2f}")
                logger.log_metrics({"eval/success": rate}, step=trainer.step)
    save()
    how = f"stopped by {stop.name}, run again to go on" if stop.name else "finished"
    print(f"{out / 'policy'}: step {trainer.step} of {total}, {how}")


def make_logger(kind: str, folder: str | Path, *, settings: Mapping[str, Any], wandb_mode: str) -> Logger:
    """TorchRL's logger ``kind``, "csv" or "wandb", writing under ``folder/log``; wandb also keeps the ``settings``."""
    wandb = {"project": "torchrl_sparse", "mode": wandb_mode, "config": dict(settings)}
    return get_logger(kind, str(Path(folder).resolve()), "log", wandb_kwargs=wandb)
