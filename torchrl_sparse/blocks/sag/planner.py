"""Sparse ActionGen (SAG, arXiv:2601.12894): a learned planner that decides from the observation.

One small network reads the encoded observation and the coordinates of all K x 3L blocks, and predicts the whole
mask of a policy call before its first denoising step (Section 3.2 of the paper)::

    z = Encoder([sin(timestep k) ; sin(block b)])         one token per block of every step
    I = MLP([W_o obs ; z])                                two logits per block: keep, prune
    M = argmax I                                          the first step is always kept

``z`` does not depend on the observation: in evaluation mode it is computed once and kept, already multiplied by
its half of the first MLP layer, so that a call costs the rest of the MLP alone. Pruned blocks reuse the latest
output of their type ("one-for-all") in the paper and their own here by default: of the policies here, an output is
nearly that of the same block one step before and little alike that of another layer (the study `looking` draws both). That
is so on long chains; on three steps the paper's rule does better (``assets/README.md``).
The paper does not publish sizes; those here keep the pruner below 0.3 % of
the dense FLOPs. :mod:`torchrl_sparse.training.pruner.trainer` trains it.

Beyond the paper, the target prune rate can be an input: one pruner then serves a range of rates, chosen call by
call through ``("diffusion", "prune_rate")``. It keeps each of them exactly: it prunes as many blocks as the rate
asks for, those of the highest logits.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse.blocks.mask import ALL_BLOCK_TYPES, BLOCK_TYPES, Reuse, check_reuse
from torchrl_sparse.blocks.planner import Planner, PlanSpec, tensors_fingerprint
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.errors import InputError
from torchrl_sparse.keys import COND, PRUNE_RATE
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.storage.tensors import read_tensors, write_tensors

__all__ = ["PrunerInfo", "SAGPruner", "check_rates", "rate_threshold"]

FORMAT = "torchrl_sparse.sag/1"


def rate_threshold(logits: Tensor, rate: Tensor) -> Tensor:
    """Return the threshold, f32 [B, 1, 1], that a share ``rate`` of each row's logits exceeds, without the first step.

    Gradients run through it: a shift of all logits changes no mask, and so has no gradient.

    Args:
        logits: f32 [B, K, 3L].
        rate: f32 [B, 1], of all K x 3L; at least one block is kept and one pruned after the first step.

    Examples:
        >>> logits = torch.tensor([[[9.0, 9.0], [1.0, 4.0], [2.0, 3.0]]])
        >>> rate_threshold(logits, torch.tensor([[0.5]])).item()
        1.5
    """
    ordered = logits[:, 1:].flatten(1).sort(descending=True).values
    count = (rate * logits.shape[1:].numel()).round().long().clamp(1, ordered.shape[1] - 1)
    return ordered.gather(1, torch.cat([count - 1, count], dim=1)).mean(dim=1)[:, None, None]


@dataclass(frozen=True)
class PrunerInfo:
    """Policy, sampler and rates that a pruner was trained for.

    Attributes:
        policy: fingerprint of the policy.
        sampler: name of its sampler, see `Sampler.name`.
        rate: prune rate that it is asked for where the TensorDict says nothing, in (0, 1).
        rate_range: lowest and highest rate that may be asked for; None where the rate is no input.
        reuse: what pruned blocks reuse.
        settings: how it was trained, for people and reports.
        block_types: blocks of a layer of the policy's network.

    Raises:
        InputError: if a field does not hold what is described here.
    """

    policy: str
    sampler: str
    rate: float
    rate_range: tuple[float, float] | None = None
    reuse: Reuse = "block"
    settings: dict[str, Any] = field(default_factory=dict)
    block_types: tuple[str, ...] = BLOCK_TYPES

    def __post_init__(self) -> None:
        object.__setattr__(self, "block_types", tuple(self.block_types))  # files bring a list
        if self.block_types not in ALL_BLOCK_TYPES:
            raise InputError(f"block_types: expected one of {ALL_BLOCK_TYPES}, got {self.block_types}")
        check_reuse(self.reuse)
        check_rates(self.rate, self.rate_range)
        if self.rate_range is not None:  # options bring a list
            object.__setattr__(self, "rate_range", tuple(self.rate_range))


@dataclass(frozen=True, kw_only=True)
class _Config(PrunerInfo):
    """The content of ``config.json``."""

    format: str
    network: dict[str, Any]


def check_rates(rate: float, rate_range: tuple[float, float] | None) -> None:
    """Raise InputError unless ``rate`` is in (0, 1), and in ``rate_range`` if there is one."""
    if not 0 < rate < 1:
        raise InputError(f"rate: expected a prune rate in (0, 1), got {rate}")
    if rate_range is not None:
        low, high = rate_range
        if not 0 < low <= rate <= high < 1:
            raise InputError(f"rate_range: expected 0 < low <= rate={rate} <= high < 1, got {low}, {high}")


class SAGPruner(Planner):
    """Planner that predicts each policy call's mask from its observation; serves only the policy that it was trained for.

    Reads ``("diffusion", "cond")`` and, if the rate is an input, ``("diffusion", "prune_rate")`` f32 [*B, 1] where
    it is there; ``rate`` stands in for it where it is not.

    Args:
        network: the trained network.
        info: what it was trained for.

    Attributes:
        rate: prune rate of the calls that do not bring their own. Assign another within ``info.rate_range``.
        format: what its ``config.json`` says that it holds.

    Examples:
        >>> from torchrl_sparse.blocks.sag.network import PrunerNetwork
        >>> network = PrunerNetwork([3, 2, 1, 0], num_blocks=6, cond_shape=(2, 5))
        >>> pruner = SAGPruner(network, PrunerInfo(policy="a policy", sampler="ddim", rate=0.7))
        >>> pruner.bind(PlanSpec(4, 2, "a policy", sampler="ddim"))
        >>> pruner.masks(torch.zeros(3, 2, 5)).shape
        torch.Size([3, 4, 6])
    """

    format: ClassVar[str] = FORMAT

    def __init__(self, network: PrunerNetwork, info: PrunerInfo) -> None:
        super().__init__()
        if network.rate_input != (info.rate_range is not None):
            raise InputError(
                f"rate_range: expected one if and only if the network reads the rate, "
                f"got {info.rate_range} and rate_input={network.rate_input}"
            )
        self.network, self.info, self.reuse = network.eval(), info, info.reuse
        steps, layers = len(network.timesteps), network.num_blocks // len(info.block_types)
        self.made_for = PlanSpec(steps, layers, info.policy, info.sampler, info.block_types)
        self.in_keys = [COND, PRUNE_RATE] if network.rate_input else [COND]
        self._rate = info.rate

    @property
    def rate(self) -> float:
        """Prune rate of policy calls that do not set their own."""
        return self._rate

    @rate.setter
    def rate(self, value: float) -> None:
        self._check_rates(torch.tensor(value), "rate")
        self._rate = value

    @property
    def flops(self) -> int:  # type: ignore[override]  # planners set theirs; this one's is never assigned
        """FLOPs of the observation-dependent part; the rest is computed once and cached."""
        return 2 * self.network.macs_per_query

    @property
    def fingerprint(self) -> str:
        """A hash of the weights and the rate."""
        return tensors_fingerprint({**self.state_dict(), "rate": torch.tensor(self.rate)})

    def options(self, tensordict: TensorDictBase, rows: int) -> dict[str, Tensor]:
        """Return the rate of every policy call, if the network takes one.

        Raises:
            InputError: if a rate is out of the range that the pruner was trained for.
        """
        if not self.network.rate_input:
            return {}
        rate = tensordict.get(PRUNE_RATE, None)
        if rate is None:
            return {"rate": torch.full((rows, 1), self.rate, device=tensordict.get(COND).device)}
        self._check_rates(rate, PRUNE_RATE)
        return {"rate": rate.reshape(rows, 1)}

    def masks(self, cond: Tensor, rate: Tensor | None = None) -> Tensor:
        """Return masks bool [B, K, 3L].

        Args:
            cond: encoded observations f32 [B, To, D].
            rate: prune rates f32 [B, 1], if they are an input.

        Raises:
            InputError: if the observations do not have the shape that the pruner was trained on.
        """
        if cond.shape[1:] != self.network.cond_shape:
            raise InputError(
                f"{COND}: expected [B, To, D] = [B, {self.network.cond_shape[0]}, {self.network.cond_shape[1]}], "
                f"got {list(cond.shape)}"
            )
        if not torch.is_grad_enabled():  # as in every collector: entering no_grad again takes time
            return self._decide(cond, rate)
        with torch.no_grad():
            return self._decide(cond, rate)

    def _decide(self, cond: Tensor, rate: Tensor | None) -> Tensor:
        if rate is None:
            return self.network.prune_masks(cond)
        logits = self.network.prune_logits(cond, rate)
        masks = logits > rate_threshold(logits, rate)
        masks[:, 0] = False
        return masks

    def save_pretrained(self, path: str | os.PathLike) -> None:
        """Write ``config.json``, with the current rate, and ``pruner.safetensors`` into the folder ``path``."""
        path = Path(path)
        write_tensors(path / "pruner.safetensors", self.network.state_dict())
        config = {
            "format": self.format,
            **asdict(self.info),
            "rate": self.rate,
            "network": self.network.config,
        }
        if self.info.block_types == BLOCK_TYPES:  # of the published transformer, which files do not name
            del config["block_types"]
        write_json(path / "config.json", config)

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike) -> SAGPruner:
        """Load a pruner written by :meth:`save_pretrained`. Nothing in the files is executed.

        Raises:
            FileNotFoundError: if a file is not there.
            InputError: naming the file, what was expected in it and what came.
        """
        path = Path(path)
        config = read_json(path / "config.json", _Config)
        if config.format != cls.format:
            raise InputError(
                f"{path / 'config.json'}: format: expected {cls.format!r}, got {config.format!r}"
            )
        info = PrunerInfo(**{field.name: getattr(config, field.name) for field in fields(PrunerInfo)})
        try:
            with torch.device("meta"):  # compared with the weights before memory is taken for it
                expected = PrunerNetwork(**config.network).state_dict()
        except (TypeError, ValueError) as error:
            raise InputError(f"{path / 'config.json'}: network: {error}") from error
        tensors = read_tensors(path / "pruner.safetensors", expected)
        network = PrunerNetwork(**config.network)
        network.load_state_dict(tensors)
        return cls(network, info)

    def _check_rates(self, rates: Tensor, name: Any) -> None:
        if self.info.rate_range is None:
            raise InputError(f"{name}: this pruner was trained for the rate {self.info.rate} alone")
        low, high = self.info.rate_range
        if not ((rates >= low) & (rates <= high)).all():
            raise InputError(
                f"{name}: expected prune rates in [{low}, {high}], got {rates.min():.3g} to {rates.max():.3g}"
            )
