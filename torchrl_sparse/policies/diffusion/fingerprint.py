"""A name of a policy's weights."""

from __future__ import annotations

import hashlib

from torch import nn

__all__ = ["weights_fingerprint"]


def weights_fingerprint(*parts: nn.Module | None) -> str:
    """Return sixteen hexadecimal digits that name configurations and weights of networks, at fp16 precision."""
    digest = hashlib.sha256()
    for part in parts:
        if part is not None:
            digest.update(repr(sorted(part.config.items())).encode())
            for name, value in sorted(part.state_dict().items()):
                digest.update(name.encode() + value.detach().cpu().half().numpy().tobytes())
    return digest.hexdigest()[:16]
