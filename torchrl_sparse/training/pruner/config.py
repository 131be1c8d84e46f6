"""Options for training gates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torchrl_sparse.blocks.mask import Reuse, check_reuse
from torchrl_sparse.blocks.sag.planner import check_rates
from torchrl_sparse.errors import InputError

__all__ = ["Cost", "PrunerConfig"]

Cost = Literal["blocks", "flops", "seconds"]


@dataclass(frozen=True)
class PrunerConfig:
    """Options of gate training; defaults as published, except ``reuse``.

    Attributes:
        objective: what the gates are to change little: ``"actions"``, the final actions of the pruned chain (SAG; static
            gates trained so are ``l2c``), or ``"noise"``, the noise predicted in a single step after a dense one, from
            noised targets (Learning-to-Cache's own; ``l2c_noise``): ``reuse`` is then ``"block"``, only every other
            step is pruned, and ``norm`` (published: ``"l2"``) is all that shapes the error.
        rate: target prune rate rho, in (0, 1), of what ``cost`` counts.
        rate_range: lowest and highest target; with it every sample of a batch gets a target of its own, uniform
            in that range, and the gates must take it as an input. They then keep it exactly, and the sparsity loss
            is 0; ``cost`` has to be ``"blocks"``.
        epochs: passes over the calibration set.
        max_updates: optimiser steps, if they shall be fewer than the epochs make; with 0, gates stay as
            `fit_to_masks` left them.
        batch_size: observations in an update.
        lr: peak learning rate, reached after 5 % of the updates; a cosine leads down to zero.
        beta: weight of the sparsity loss.
        norm: of the fidelity loss, ``"l1"`` or ``"l2"``.
        estimator: ``"ste"`` (straight-through) or ``"gumbel"`` (straight-through Gumbel-softmax).
        temperature: of ``"gumbel"``, at the first update.
        final_temperature: of ``"gumbel"`` at the last update; between, it falls or rises by the same factor in every
            update. None leaves it as it is.
        variety: weight of a reward for masks that follow the observation, see
            :func:`~torchrl_sparse.training.pruner.loss.variety_reward`; 0 as published.
        information: bits of a cell up to which variety is rewarded, by its logarithm; None rewards it by itself, without end.
        sparsity: ``"global"``, or ``"block"``: every block has to reach the rate by itself (the paper's ablation).
        cost: what the rate counts: ``"blocks"`` (published), or each weighed by the ``"flops"`` or the measured
            ``"seconds"`` of its type.
        reuse: what pruned blocks reuse, see :mod:`torchrl_sparse.blocks.mask`: ``"block"``, as in all policies here, or the
            paper's one-for-all, ``"type"``.
        gradient: ``"chain"`` differentiates the whole chain of denoising steps; ``"step"`` cuts it between them
            (:func:`~torchrl_sparse.blocks.sag.relaxed.step_errors` says what is lost).
        detached: whether outputs are kept for reuse without their gradient, as the release of SAG's successor does
            (:mod:`torchrl_sparse.blocks.sag.relaxed`); SAG's equation has it run through them.
        explore: share of the pruned blocks that an update evaluates to learn what they are worth; the smaller,
            the cheaper an update and the noisier its gradient.
        checkpointed: recompute denoising steps in the backward pass, for the memory of one step.
        max_grad_norm: gradient norm clip.
        seed: fixes everything random.

    Raises:
        InputError: if a value is out of its range.
    """

    objective: Literal["actions", "noise"] = "actions"
    rate: float = 0.91
    rate_range: tuple[float, float] | None = None
    epochs: int = 30
    max_updates: int | None = None
    batch_size: int = 32
    lr: float = 1e-4
    beta: float = 1.0
    norm: Literal["l1", "l2"] = "l1"
    estimator: Literal["ste", "gumbel"] = "ste"
    temperature: float = 1.0
    final_temperature: float | None = None
    variety: float = 0.0
    information: float | None = None
    sparsity: Literal["global", "block"] = "global"
    cost: Cost = "blocks"
    reuse: Reuse = "block"
    gradient: Literal["chain", "step"] = "chain"
    detached: bool = False
    explore: float = 1.0
    checkpointed: bool = True
    max_grad_norm: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, allowed in (
            ("objective", ("actions", "noise")),
            ("norm", ("l1", "l2")),
            ("estimator", ("ste", "gumbel")),
            ("sparsity", ("global", "block")),
            ("cost", get_args(Cost)),
            ("gradient", ("chain", "step")),
        ):
            if (value := getattr(self, name)) not in allowed:
                raise InputError(f"{name}: expected one of {list(allowed)}, got {value!r}")
        check_reuse(self.reuse)
        if self.objective == "noise" and self.reuse != "block":
            raise InputError(f"reuse: expected 'block' with objective 'noise', got {self.reuse!r}")
        check_rates(self.rate, self.rate_range)
        if self.rate_range is not None:  # YAML brings a list
            object.__setattr__(self, "rate_range", tuple(self.rate_range))
            if self.cost != "blocks":
                raise InputError(f"cost: expected 'blocks' with a rate_range, got {self.cost!r}")
        for name in ("epochs", "batch_size", "lr", "temperature", "final_temperature"):
            if (value := getattr(self, name)) is not None and not value > 0:
                raise InputError(f"{name}: expected a positive number, got {value}")
        if not self.variety >= 0:
            raise InputError(f"variety: expected a weight >= 0, got {self.variety}")
        if self.information is not None and not 0 < self.information <= 1:
            raise InputError(f"information: expected bits in (0, 1], or None, got {self.information}")
        if self.information is not None and self.variety == 0:
            raise InputError(f"information: expected None without variety, got {self.information}")

    def temperature_at(self, progress: float) -> float:
        """Return the temperature at a fraction of the training, 0 to 1.

        >>> PrunerConfig(temperature=4.0, final_temperature=0.25).temperature_at(0.5)
        1.0
        """
        final = self.temperature if self.final_temperature is None else self.final_temperature
        return self.temperature * (final / self.temperature) ** progress
