"""Fingerprints of policies, for everything made for one of them: schedules, pruners, episodes, calibrations."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor, nn

__all__ = ["full_fingerprint", "is_same_policy", "networks_fingerprint", "policy_fingerprint"]

_DIGITS, _DIGITS_OF_UNITS = 16, 8


def networks_fingerprint(*networks: nn.Module) -> str:
    """Return sixteen hexadecimal digits that identify networks' configs and weights, at the fp16 precision of their files.

    Args:
        networks: each with a dict ``config`` beside its weights.
    """
    digest = hashlib.sha256()
    for network in networks:
        digest.update(repr(sorted(network.config.items())).encode())
        for name, value in sorted(network.state_dict().items()):
            digest.update(name.encode() + value.detach().cpu().half().numpy().tobytes())
    return digest.hexdigest()[:_DIGITS]


def policy_fingerprint(
    *networks: nn.Module, normalizer: Mapping[str, Tensor], trained: Mapping[str, Any]
) -> str:
    """Return the `networks_fingerprint`, a hyphen, and eight digits that identify normaliser and training settings.

    Args:
        networks: see `networks_fingerprint`.
        normalizer: tensors of the normaliser, f32 in files.
        trained: what a sampler of these networks has in common with all others, see `Sampler.trained`.
    """
    units = [repr(sorted(trained.items())).encode()]
    for name, value in sorted(normalizer.items()):
        units.append(name.encode() + value.detach().cpu().float().numpy().tobytes())
    return full_fingerprint(networks_fingerprint(*networks), b"".join(units))


def full_fingerprint(weights: str, units: bytes) -> str:
    """Return a weights' fingerprint, a hyphen, and eight digits that identify normaliser and training settings.

    >>> full_fingerprint("0123456789abcdef", b"[-1, 1]")
    '0123456789abcdef-3981c725'
    """
    return f"{weights}-{hashlib.sha256(units).hexdigest()[:_DIGITS_OF_UNITS]}"


def is_same_policy(noted: Any, asked: Any) -> bool:
    """Tell whether a file's noted fingerprint is ``asked``, or the older form of it.

    Older fingerprints identify the weights alone: policies that differ only in their normaliser share one.

    >>> is_same_policy("0123456789abcdef", "0123456789abcdef-01234567"), is_same_policy("a", "a-b")
    (True, False)
    """
    if noted == asked:
        return True
    if not (isinstance(noted, str) and isinstance(asked, str)):
        return False
    weights, hyphen, units = asked.partition("-")
    lengths = len(weights), len(units)
    return noted == weights and bool(hyphen) and lengths == (_DIGITS, _DIGITS_OF_UNITS)
