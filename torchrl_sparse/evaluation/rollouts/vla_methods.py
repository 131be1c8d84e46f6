"""The methods of a vision-language-action benchmark by name, and the queries on which they are compared."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.planner import tensors_fingerprint
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.networks.vla.vision import center_crop
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens import (
    EfficientVLAPruner,
    FastVPruner,
    FrameDifferencePruner,
    RandomPruner,
    SparseVLMPruner,
    SpecPrune,
    VLACachePruner,
)
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.training.vla.token_budget import replay

__all__ = ["TokenMethod", "matching_share", "mid_episode_query", "seen_images"]

DENSE = "dense"
_SPECPRUNE = {
    "specprune": {},
    "specprune_uncontrolled": {},
    "specprune_static": {"dynamic": False},
}
# Each takes one number first: the share of the visual tokens that it keeps or, the last two, of what its own rule drops.
_BASELINES: Mapping[str, Callable[..., TokenPruner]] = {
    "fastv": FastVPruner,
    "random": RandomPruner,
    "frame_difference": FrameDifferencePruner,
    "efficientvla": EfficientVLAPruner,
    "vla_cache": VLACachePruner,
    "sparsevlm": SparseVLMPruner,
}
_MATCHED = ("fastv", "random", "frame_difference", "efficientvla")
_HALVINGS = 10


@dataclass(frozen=True)
class TokenMethod:
    """A method as it is written: ``NAME``, ``NAME@NUMBER``, or ``NAME@OTHER`` for as many tokens as another method kept.

    Attributes:
        name: ``dense``; ``specprune``, with the controller; its ablations ``specprune_uncontrolled`` (static and dynamic
            pruning) and ``specprune_static``; or a baseline: ``fastv``, ``random``, ``frame_difference``, ``efficientvla``,
            ``vla_cache``, ``sparsevlm``.
        number: SpecPrune's alpha, or the baseline's first argument; None for its default.
        like: the method whose tokens are matched.

    Examples:
        >>> TokenMethod.parse("fastv@0.3")
        TokenMethod(name='fastv', number=0.3, like=None)
        >>> TokenMethod.parse("random@specprune").like
        'specprune'
    """

    name: str
    number: float | None = None
    like: str | None = None

    @classmethod
    def parse(cls, text: str) -> TokenMethod:
        """Raises ValueError unless ``text`` is written as above."""
        name, at, rest = text.partition("@")
        names = (DENSE, *_SPECPRUNE, *_BASELINES)
        if name not in names or (at and name == DENSE):
            raise ValueError(f"methods: expected one of {', '.join(names)}, or NAME@NUMBER, got {text!r}")
        if not at:
            return cls(name)
        if re.fullmatch(r"\d*\.?\d+", rest):
            return cls(name, number=float(rest))
        if name in _MATCHED and rest.partition("@")[0] in names:
            return cls(name, like=rest)
        raise ValueError(
            f"methods: expected {name}@NUMBER{f' or {name}@METHOD' if name in _MATCHED else ''}, got {text!r}"
        )

    def pruner(
        self, number: float | None = None, options: Mapping[str, Any] | None = None
    ) -> TokenPruner | None:
        """What prunes.

        Args:
            number: takes the place of `number`, for methods that match another.
            options: of SpecPrune, see `SpecPruneOptions`; other methods do not read them.
        """
        number = self.number if number is None else number
        if self.name == DENSE:
            return None
        if self.name in _SPECPRUNE:
            alpha = {} if number is None else {"alpha": number}
            return SpecPrune(**{**(options or {}), **_SPECPRUNE[self.name], **alpha})
        return _BASELINES[self.name](*([] if number is None else [number]))

    def executor(self, policy: VLAPolicy, n_action_steps: int) -> ChunkExecutor:
        """``policy`` under this method's controller, if it has one."""
        controller = ActionAwareController() if self.name == "specprune" else None
        return ChunkExecutor(policy, n_action_steps, controller)


def method_identity(
    text: str, number: float | None, policy: VLAPolicy, options: Mapping[str, Any]
) -> dict[str, Any]:
    """What makes the episodes of one method its own, as JSON values for an `EpisodeLog`."""
    fixed = {"method": text, "number": number, "policy": tensors_fingerprint(policy.state_dict())}
    return fixed | ({"options": dict(options)} if TokenMethod.parse(text).name in _SPECPRUNE else {})


def matching_share(
    make: Callable[[float], TokenPruner],
    policy: VLAPolicy,
    episodes: Iterable[Sequence[TensorDictBase]],
    kept: float,
) -> float:
    """The share at which a pruner keeps ``kept`` visual tokens in a decoder layer, mean over layers and all queries.

    Args:
        make: called with a share in (0, 1]; more of it keeps more.
        episodes: their queries, as `recorded_queries` yields them.

    Raises:
        ValueError: if even the smallest share keeps more.
    """
    episodes = list(episodes)

    def keeps(share: float) -> float:
        answers = [replay(policy, queries, make(share)) for queries in episodes]
        return torch.cat([answer[keys.KEPT] for answer in answers]).mean().item()

    low, high = 2.0**-_HALVINGS, 1.0
    if (least := keeps(low)) > kept:
        raise ValueError(
            f"expected a pruner that can keep as few as {kept:.1f} visual tokens, got at least {least:.1f}"
        )
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if keeps(middle) <= kept else (low, middle)
    return low


@torch.no_grad()
def mid_episode_query(policy: VLAPolicy, queries: Sequence[TensorDictBase]) -> TensorDictBase:
    """The middle one of an episode's queries, [], with what the policy remembers of those before."""
    last = len(queries) // 2
    answers = replay(policy, queries[: last + 1], policy.pruner)
    remembered = [key for key in policy.out_keys if key in policy.in_keys]
    query = queries[last].exclude(*remembered)
    return query.update(answers[last - 1].select(*remembered)) if last else query


def seen_images(policy: VLAPolicy, step: TensorDictBase) -> Tensor:
    """u8 [V, 3, h, w] of one step, cropped as the network sees them."""
    config = policy.network.config
    images = torch.stack([keys.read(step, camera) for camera in config.cameras])
    return center_crop(images, config.crop_area)
