"""Device names and their check."""

from __future__ import annotations

import torch

from torchrl_sparse.errors import InputError

__all__ = ["check_device"]


def check_device(name: str) -> str:
    """Return the device name if this machine and PyTorch have the device; otherwise raise InputError.

    Raises:
        InputError: if it has none of that name.

    >>> check_device("cpu")
    'cpu'
    >>> check_device("abacus")
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: expected one that this machine and PyTorch have, got 'abacus'
    """
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:  # of a name that is none, and without CUDA compiled in
        raise InputError(f"expected one that this machine and PyTorch have, got {name!r}") from error
    return name
