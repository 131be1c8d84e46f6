"""Matrix products with fixed weights, in PyTorch's fastest form."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["Linear", "can_pack", "make_linear", "transposed"]

Linear = Callable[[Tensor, Tensor], Tensor]


def make_linear(weight: Tensor, bias: Tensor, gelu: str | None = None) -> Linear:
    """Prepare ``(x [N, in], out [N, out]) -> [N, out]``, with GELU behind it if asked for: ``"none"``, or ``"tanh"``, as
    `torch.nn.GELU` names its approximations.

    The general product puts its result into ``out``. But ten rows leave it at a half of the speed that the
    weights could be read with; oneDNN's product on weights that were laid out for it in advance (what
    Inductor emits for a CPU) gets closer. That one returns memory of its own, PyTorch offers no other form.
    """
    weight, bias = weight.detach(), bias.detach().clone()
    if can_pack(weight):
        packed = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous())
        product = torch.ops.mkldnn._linear_pointwise.default
        activation, algorithm = ("gelu", gelu) if gelu else ("none", "")
        return lambda x, out: product(x, packed, bias, activation, [], algorithm)
    right = transposed(weight)
    if gelu:
        return lambda x, out: torch.ops.aten.gelu_(torch.addmm(bias, x, right, out=out), approximate=gelu)
    return lambda x, out: torch.addmm(bias, x, right, out=out)


def can_pack(weight: Tensor) -> bool:
    """Return whether ``weight`` can be packed for oneDNN: float32, on a CPU, in a PyTorch built with it."""
    available = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")
    return available and weight.device.type == "cpu" and weight.dtype == torch.float32


def transposed(weight: Tensor) -> Tensor:
    """Return a contiguous copy of the transpose."""
    return weight.t().clone(memory_format=torch.contiguous_format)
