"""Layer norms of the PyTorch engine, reduced by folding to a division by the vector's length.

Nothing ever sees the mean of the residual stream, so what is added to it is centred beforehand, in the weights that make
it. A norm is then ``x / sqrt(|x|^2 + d eps)`` and a factor sqrt(d), which goes into the weights behind it.
"""

from __future__ import annotations

from torch import Tensor

from torchrl_sparse.blocks.engine.folding import Affine, FoldedLayer

__all__ = ["after_length", "centred", "without_norms"]


def without_norms(layer: FoldedLayer) -> FoldedLayer:
    """Rewrite a folded ``layer`` so that it reads the stream divided by its length, and adds centred outputs to it."""
    return FoldedLayer(
        qkv=after_length(layer.qkv),
        out=_centred(layer.out),
        up=after_length(layer.up),
        down=_centred(layer.down),
        query=after_length(layer.query),
        key_value=layer.key_value,
        cross_out=_centred(layer.cross_out),
    )


def after_length(layer: Affine) -> Affine:
    """Rewrite a folded ``layer``, weight [..., d], to read ``x / sqrt(|x|^2 + d eps)`` of a centred x instead of its norm.

    >>> import torch
    >>> x = torch.tensor([1.0, -3.0, 0.0, 2.0])
    >>> weight, bias = after_length(Affine(torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.zeros(1)))
    >>> norm = torch.nn.functional.layer_norm(x, [4])
    >>> torch.allclose(weight @ (x / (x @ x + 4e-5).sqrt()), norm @ torch.arange(1.0, 5))
    True
    """
    return Affine(layer.weight * layer.weight.shape[-1] ** 0.5, layer.bias)


def centred(tensor: Tensor, dim: int = -1) -> Tensor:
    """Return ``tensor`` without its mean over ``dim``.

    >>> import torch
    >>> centred(torch.tensor([1.0, 2.0, 6.0]))
    tensor([-2., -1.,  3.])
    """
    exact = tensor.detach().double()
    return (exact - exact.mean(dim=dim, keepdim=True)).to(tensor)


def _centred(layer: Affine) -> Affine:
    return Affine(*(centred(part, dim=0) for part in layer))
