"""Frozen policies, for inference only: weights cannot be written, so calls need not check them for changes."""

from __future__ import annotations

import sys

from tensordict.nn import TensorDictSequential
from torch import nn

from torchrl_sparse.networks.fingerprint import policy_fingerprint
from torchrl_sparse.networks.frozen import Frozen, FrozenDict, FrozenError
from torchrl_sparse.policies.diffusion.shortcut import Parts
from torchrl_sparse.policies.diffusion.sizes import PolicySizes

if sys.version_info >= (3, 11):
    from typing import Self
else:
    from typing_extensions import Self

__all__ = ["FreezablePolicy"]


class FreezablePolicy(PolicySizes, TensorDictSequential):
    """Part of a `DiffusionPolicy` that depends on whether its weights may change."""

    _parts: Parts | None = None

    def freeze(self) -> Self:
        """Refuse all writes to the weights from now on, so that calls skip the check for changes; return the policy.

        A write is an error, never an old answer: an optimiser's step, ``load_state_dict``, ``.data``, a move, a
        parameter or module exchanged for another, also in policies that share the networks, as `with_plan` makes them. Weights
        move in memory, so that what shared theirs before does no longer; a write to that is an error of the next policy call.
        Not
        seen are writes around PyTorch: to a storage, or to an address. Plan, sampler, start, engine and noise may change.

        ``copy.deepcopy(policy)``, a pickle, a worker of a collector and a saved policy are not frozen: freeze them again.
        TorchRL's collectors exchange weights for a while where their ``policy_device`` is not the policy's. That is refused.

        Examples:
            >>> from torchrl_sparse import DiffusionPolicy
            >>> policy = DiffusionPolicy.from_pretrained("assets/lift").freeze()
            >>> policy.network.head.bias.data.zero_()
            Traceback (most recent call last):
            ...
            torchrl_sparse.networks.frozen.FrozenError: network.head.bias: frozen by policy.freeze(); change ...
        """
        self.eval()
        frozen = {name: Frozen.of(part) or Frozen(part, name) for name, part in self._weights().items()}
        encode, denoise = self.module["encode"], self.module["denoise"]
        for name, stage in {
            "encode": encode,
            "encode.condition": encode.condition,
            "denoise": denoise,
        }.items():
            stage.__dict__["_modules"] = FrozenDict(stage._modules, name, frozen["network"])
        self._parts = Parts.of(encode, denoise, frozen["normalizer"])
        return self

    @property
    def frozen(self) -> bool:
        """Whether `freeze` was called on this policy or on another that shares its networks."""
        return all(Frozen.of(part) is not None for part in self._weights().values())

    def train(self, mode: bool = True) -> Self:
        """Set training mode; a frozen policy raises FrozenError."""
        if mode and self.frozen:
            raise FrozenError("policy.train()")
        return super().train(mode)

    @property
    def fingerprint(self) -> str:
        """Hash of the weights, at the fp16 precision of saved files, and of normaliser and training steps.

        Planners and episodes belong to one policy. Earlier files name the weights alone, the part before the hyphen.
        """
        frozen, *others = map(Frozen.of, self._weights().values())
        if frozen is None or None in others:
            return self._fingerprint()
        return frozen.once((*others, repr(self.sampler.trained)), self._fingerprint)

    def _fingerprint(self) -> str:
        units = {"normalizer": self.normalizer.state_dict(), "trained": self.sampler.trained}
        return policy_fingerprint(self.network, *filter(None, [self.vision]), **units)

    def _weights(self) -> dict[str, nn.Module]:
        parts = {"network": self.network, "normalizer": self.normalizer, "vision": self.vision}
        return {name: part for name, part in parts.items() if part is not None}
