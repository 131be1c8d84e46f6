"""A name of networks' weights, for everything that is made for one policy."""

from __future__ import annotations

import hashlib

from torch import nn

__all__ = ["networks_fingerprint"]


def networks_fingerprint(*networks: nn.Module) -> str:
    """Return sixteen hexadecimal digits that name the configs and weights of networks, at the fp16 precision of their files.

    Args:
        networks: each with a dict ``config`` beside its weights.
    """
    digest = hashlib.sha256()
    for network in networks:
        digest.update(repr(sorted(network.config.items())).encode())
        for name, value in sorted(network.state_dict().items()):
            digest.update(name.encode() + value.detach().cpu().half().numpy().tobytes())
    return digest.hexdigest()[:16]
