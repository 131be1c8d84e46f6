"""Token selection: ranks, the best tokens of each camera, and checks that a budget fits the model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import VisualSpec

__all__ = ["best", "best_per_camera", "check_budget", "check_share", "ranks", "scaled_layers"]


def ranks(score: Tensor, among: Tensor) -> Tensor:
    """Rank the tokens, i64 [B, N]: 0 is the highest score; ties in the order of ids; those not ``among`` come last.

    Args:
        score: [B, N].
        among: bool [B, N], the tokens that compete.

    Examples:
        >>> ranks(torch.tensor([[0.1, 0.7, 0.9, 0.7]]), torch.tensor([[True, True, False, True]]))
        tensor([[2, 0, 3, 1]])
    """
    order = score.masked_fill(~among, -torch.inf).argsort(dim=-1, descending=True, stable=True)
    places = torch.arange(score.shape[-1], device=score.device).expand_as(order)
    return torch.empty_like(order).scatter(-1, order, places)


def best(score: Tensor, count: Tensor | int, among: Tensor) -> Tensor:
    """Choose the ``count`` tokens with the highest scores, bool [B, N]; all candidates if there are fewer.

    Args:
        score: [B, N].
        count: one number, or i64 [B, 1], one per row.
        among: bool [B, N], the tokens that compete.

    Examples:
        >>> best(torch.tensor([[3.0, 1.0, 2.0]] * 2), torch.tensor([[1], [2]]), torch.ones(2, 3).bool()).int()
        tensor([[1, 0, 0],
                [1, 0, 1]], dtype=torch.int32)
    """
    return (ranks(score, among) < count) & among


def best_per_camera(score: Tensor, counts: Sequence[Tensor | int], among: Tensor) -> Tensor:
    """Choose the `best` within each camera, bool [B, N]; tokens are ordered by camera, equally many each.

    Args:
        counts: one number, or i64 [B, 1], per camera.
    """
    cameras = len(counts)
    parts = zip(score.chunk(cameras, -1), counts, among.chunk(cameras, -1), strict=True)
    return torch.cat([best(*part) for part in parts], -1)


def scaled_layers(layers: Sequence[int], depth: int, num_layers: int, first: int = 0) -> list[int]:
    """Map layers of a model ``depth`` deep to the same relative depth in ``num_layers``; keep those from ``first`` on.

    Examples:
        >>> scaled_layers([5, 10, 15, 20], 32, 32, 2), scaled_layers([5, 10, 15, 20], 32, 8, 2)
        ([5, 10, 15, 20], [2, 4, 5])
    """
    scaled = {round(layer * num_layers / depth) for layer in layers}
    return sorted(layer for layer in scaled if first <= layer < num_layers)


def check_budget(name: str, budget: float, spec: VisualSpec) -> None:
    """Refuse more tokens per camera than the model has.

    Raises:
        InputError: naming the budget and the model's tokens.
    """
    if not 0 < budget <= spec.per_camera:
        raise InputError(
            f"{name}: expected more than 0 and at most the model's {spec.per_camera} tokens per camera, got {budget:g}"
        )


def check_share(name: str, share: float) -> None:
    """Refuse a share outside (0, 1].

    Raises:
        InputError: naming it.
    """
    if not 0 < share <= 1:
        raise InputError(f"{name}: expected more than 0 and at most 1, got {share:g}")
