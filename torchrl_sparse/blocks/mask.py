"""Prune masks over (denoising step × block): their meaning, checks, and costs.

A mask is bool [*B, K, 3L] with **True = pruned** (the symbol M of SAG, arXiv:2601.12894). Axis K counts the
calls of the network in execution order: step 0 is the first, noisiest call. (The BAC paper, arXiv:2506.13456,
counts diffusion timesteps, which run down; ``Sampler.timesteps[step]`` translates.) The column names
the block: ``3 * layer + {0: SA, 1: CA, 2: FFN}``. Row 0 never prunes, so there is always something to reuse.
Of a network without cross-attention, masks are bool [*B, K, 2L], column ``2 * layer + {0: SA, 1: FFN}``.

A pruned block adds an earlier output to the residual stream. Which one is the *reuse rule*:

* ``"block"``: its own most recent output (BAC, update-then-reuse).
* ``"type"``: the most recent output of *any* block of its type, be it of a shallower layer of the same step
  or of a deeper layer of an earlier one (SAG, "one-for-all" buffers with zig-zag reuse).
* ``"single"``: the most recent output of any block (the single buffer that SAG's printed equation has).

Costs follow the published convention: FLOPs = 2 · multiply-accumulates, over all K calls of the denoiser,
vision excluded, and without counting norms, softmax and activations. For d=256, L=8, H=10, To=2 and K=100
this is the 15.75 G of the papers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.denoiser import ALL_BLOCK_TYPES, BLOCK_TYPES, Denoiser

__all__ = [
    "ALL_BLOCK_TYPES",
    "BLOCK_TYPES",
    "REUSED_COLOR",
    "REUSE_RULES",
    "TYPE_COLORS",
    "MaskError",
    "NetworkSizes",
    "Reuse",
    "block_macs",
    "block_name",
    "check_form",
    "check_reuse",
    "fixed_macs",
    "mask_flops",
    "mask_from_steps",
    "num_buffers",
    "prune_rate",
    "query_flops",
    "steps_from_mask",
    "validate_mask",
]

TYPE_COLORS = ("#0072B2", "#009E73", "#D55E00")
"""Of computed blocks in figures, in the order of `BLOCK_TYPES`: Okabe and Ito's, which colour-blind readers tell apart."""

REUSED_COLOR = "#E9E9EC"
"""Of pruned blocks in figures."""

Reuse = Literal["block", "type", "single"]
REUSE_RULES: tuple[Reuse, ...] = get_args(Reuse)


def block_name(column: int, types: Sequence[str] = BLOCK_TYPES) -> str:
    """Return the name of a mask column, as in the BAC paper; ``types`` are the blocks of a layer.

    >>> block_name(17), block_name(17, ("SA", "FFN"))
    ('layers.5.FFN', 'layers.8.FFN')
    """
    layer, kind = divmod(column, len(types))
    return f"layers.{layer}.{types[kind]}"


class MaskError(InputError):
    """Error for a tensor that is not a prune mask; the message says what was expected and what came."""


def validate_mask(
    mask: Tensor,
    num_steps: int,
    num_layers: int,
    batch: Sequence[int] | None = None,
    types: Sequence[str] = BLOCK_TYPES,
) -> None:
    """Refuse anything that is not a prune mask.

    Args:
        mask: the candidate.
        num_steps: denoising steps K.
        num_layers: layers L.
        batch: expected leading dimensions; None accepts any.
        types: blocks of a layer.

    Raises:
        MaskError: if ``mask`` is no bool tensor [*batch, K, 3L] or if its first row prunes.

    >>> validate_mask(torch.zeros(4, 10, 6, dtype=torch.bool), num_steps=10, num_layers=2)
    """
    check_form(mask, num_steps, num_layers, batch, types)
    first = mask.select(-2, 0)
    if (
        first.any()
    ):  # one operation where nothing is wrong: every policy call of every method comes through here
        pruned = first.reshape(-1, first.shape[-1]).any(dim=0).nonzero().flatten().tolist()
        names = ", ".join(block_name(column, types) for column in pruned)
        raise MaskError(
            f"prune mask: expected row 0 (the first denoising step) to prune nothing, got True for {names}"
        )


def check_form(
    mask: Tensor,
    num_steps: int,
    num_layers: int,
    batch: Sequence[int] | None = None,
    types: Sequence[str] = BLOCK_TYPES,
) -> None:
    """Check type and shape of a prune mask, without reading its values; see :func:`validate_mask`.

    Raises:
        MaskError: if ``mask`` is no bool tensor [*batch, K, 3L].
    """
    tail = (num_steps, len(types) * num_layers)
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        came = f"dtype {mask.dtype}" if isinstance(mask, Tensor) else type(mask).__name__
        raise MaskError(f"prune mask: expected a tensor of dtype torch.bool, got {came}")
    if mask.is_meta or mask.layout != torch.strided:
        came = "the meta device" if mask.is_meta else f"layout {mask.layout}"
        raise MaskError(f"prune mask: expected a dense tensor with values, got {came}")
    lead = "*B, " if batch is None else "".join(f"{size}, " for size in batch)
    if mask.shape[-2:] != tail or (batch is not None and mask.shape[:-2] != tuple(batch)):
        raise MaskError(
            f"prune mask: expected shape [{lead}{tail[0]}, {tail[1]}] (K={num_steps} denoising steps, "
            f"{len(types)}L={tail[1]} blocks), got {list(mask.shape)}"
        )


def check_reuse(reuse: str) -> None:
    """Raise InputError unless ``reuse`` names a reuse rule."""
    if reuse not in REUSE_RULES:
        raise InputError(f"reuse: expected one of {list(REUSE_RULES)}, got {reuse!r}")


def num_buffers(reuse: Reuse, num_blocks: int, types: Sequence[str] = BLOCK_TYPES) -> int:
    """Return the number of block outputs that a reuse rule keeps; block ``b`` uses buffer ``b % num_buffers``.

    ``types`` are the blocks of a layer.

    >>> num_buffers("type", num_blocks=24)
    3
    """
    check_reuse(reuse)
    return {"block": num_blocks, "type": len(types), "single": 1}[reuse]


def prune_rate(mask: Tensor) -> Tensor:
    """Return the prune rate ρ f32 [*B], the mean of a mask bool [*B, K, 3L] over all steps (row 0 too) and blocks.

    >>> prune_rate(torch.tensor([[False] * 3, [True, True, True]])).item()
    0.5
    """
    return mask.float().mean(dim=(-2, -1))


def mask_from_steps(steps: Sequence[Iterable[int]], num_steps: int) -> Tensor:
    """Make a mask bool [K, 3L] from the computed steps of every block, in column order.

    >>> mask_from_steps([[0, 2], [0], [0, 1]], num_steps=3).int().tolist()
    [[0, 0, 0], [1, 1, 0], [0, 1, 1]]
    """
    mask = torch.ones(num_steps, len(steps), dtype=torch.bool)
    for column, computed in enumerate(steps):
        mask[list(computed), column] = False
    return mask


def steps_from_mask(mask: Tensor) -> tuple[tuple[int, ...], ...]:
    """Return the computed steps of every block of a mask bool [K, 3L]: the inverse of :func:`mask_from_steps`."""
    return tuple(tuple((~column).nonzero().flatten().tolist()) for column in mask.unbind(dim=1))


@dataclass(frozen=True)
class NetworkSizes:
    """Sizes of a denoiser that determine its cost.

    Attributes:
        num_layers: layers L.
        horizon: actions in a chunk H.
        n_obs_steps: observations To; of the published transformer, the memory holds 1 + To tokens.
        width: embedding size d.
        input_dim: size of a noisy action.
        output_dim: size of a prediction.
        cond_dim: size of one encoded observation.
        num_cond_layers: layers of the condition encoder; 0 is the token-wise MLP of the published models.
        time_dim: of an `AdaLNTransformer`, size of the timestep's embedding; None of the published transformer.
    """

    num_layers: int
    horizon: int
    n_obs_steps: int
    width: int
    input_dim: int
    output_dim: int
    cond_dim: int
    num_cond_layers: int = 0
    time_dim: int | None = None

    @classmethod
    def of(cls, network: Denoiser) -> NetworkSizes:
        """Read the sizes of ``network``."""
        return cls(
            num_layers=network.n_layer,
            horizon=network.horizon,
            n_obs_steps=network.n_obs_steps,
            width=network.n_emb,
            input_dim=network.input_dim,
            output_dim=network.output_dim,
            cond_dim=network.cond_dim,
            num_cond_layers=network.config.get("n_cond_layers", 0),
            time_dim=network.time_dim if isinstance(network, AdaLNTransformer) else None,
        )

    @property
    def block_types(self) -> tuple[str, ...]:
        """The blocks of a layer."""
        return BLOCK_TYPES if self.time_dim is None else AdaLNTransformer.block_types


def block_macs(sizes: NetworkSizes) -> tuple[int, ...]:
    """Count the multiply-accumulates of one block of each type in one call, batch 1.

    Adaptive layer norms are counted with their blocks, as published code computes them, time and observations in every call.

    >>> lift = NetworkSizes(8, horizon=10, n_obs_steps=2, width=256, input_dim=10, output_dim=10, cond_dim=19)
    >>> [round(macs / sum(block_macs(lift)), 3) for macs in block_macs(lift)]
    [0.277, 0.178, 0.544]
    """
    d, tokens, memory = sizes.width, sizes.horizon, 1 + sizes.n_obs_steps
    self_attention = 4 * d * d * tokens + 2 * tokens * tokens * d
    feed_forward = 8 * d * d * tokens
    if sizes.time_dim is not None:
        modulation = 3 * d * (sizes.time_dim + sizes.n_obs_steps * sizes.cond_dim)
        return self_attention + modulation, feed_forward + modulation
    cross_attention = 2 * d * d * tokens + 2 * d * d * memory + 2 * tokens * memory * d
    return self_attention, cross_attention, feed_forward


def fixed_macs(sizes: NetworkSizes) -> int:
    """Count the multiply-accumulates of one call outside the blocks, which are never pruned: stems, condition encoder, head."""
    d, memory = sizes.width, 1 + sizes.n_obs_steps
    stem_and_head = (sizes.input_dim + sizes.output_dim) * d * sizes.horizon
    if sizes.time_dim is not None:
        return 4 * sizes.time_dim**2 + stem_and_head
    encoder = 8 * d * d * memory
    if sizes.num_cond_layers:
        encoder = sizes.num_cond_layers * (12 * d * d * memory + 2 * memory * memory * d)
    return encoder + sizes.cond_dim * d * sizes.n_obs_steps + stem_and_head


def query_flops(network: Denoiser | NetworkSizes, mask: Tensor) -> Tensor:
    """Count the FLOPs (2 · MAC) of one policy call under ``mask``, over all K calls of the denoiser.

    Args:
        network: the denoiser or its sizes.
        mask: bool [*B, K, 3L]; K is read from it.

    Returns:
        f32 [*B].

    Raises:
        InputError: if ``mask`` is no prune mask for a network of this depth.

    >>> lift = NetworkSizes(8, horizon=10, n_obs_steps=2, width=256, input_dim=10, output_dim=10, cond_dim=19)
    >>> round(query_flops(lift, torch.zeros(100, 24, dtype=torch.bool)).item() / 1e9, 2)
    15.74
    """
    sizes = network if isinstance(network, NetworkSizes) else NetworkSizes.of(network)
    num_steps = mask.shape[-2] if isinstance(mask, Tensor) and mask.ndim >= 2 else 1
    validate_mask(mask, num_steps, sizes.num_layers, types=sizes.block_types)
    return mask_flops(sizes, mask)


def mask_flops(sizes: NetworkSizes, mask: Tensor) -> Tensor:
    """Return :func:`query_flops` of a mask that has already been validated."""
    num_steps = mask.shape[-2]
    # Summed as whole numbers: a policy call exceeds what float32 counts exactly.
    skipped = (mask.sum(dim=-2) * _block_flops(sizes).to(mask.device)).sum(dim=-1)
    dense = 2 * num_steps * (sizes.num_layers * sum(block_macs(sizes)) + fixed_macs(sizes))
    return (dense - skipped).float()


@lru_cache(maxsize=16)
def _block_flops(sizes: NetworkSizes) -> Tensor:
    """Count the FLOPs of every block, i64 [3L]."""
    return 2 * torch.tensor(block_macs(sizes)).repeat(sizes.num_layers)
