"""Methods of a vision-language-action benchmark on recorded policy calls: matched in tokens, run one after another."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.planner import tensors_fingerprint
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.methods.vla import TOKEN_METHODS, Settings, parse_token_method, settings_of
from torchrl_sparse.networks.fingerprint import full_fingerprint
from torchrl_sparse.networks.vla.vision import center_crop
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.training.vla.token_budget import replay

__all__ = ["matching_share", "method_identity", "prepared_queries", "seen_images"]

_HALVINGS = 10


def method_identity(
    text: MethodSpec | str, number: float | None, policy: VLAPolicy, settings: Settings
) -> dict[str, Any]:
    """Return the JSON values that tell one method's episodes from others', for an `EpisodeLog`.

    Args:
        text: the method, see `torchrl_sparse.methods.vla`.
        number: that its pruner was made with.
        policy: whose weights answered.
        settings: sections that its pruner was made with.
    """
    # sizes that no tensor shows, as the share of an image that is cropped and the number of heads
    sizes = json.dumps(policy.network.config.to_dict(), sort_keys=True).encode()
    fingerprint = full_fingerprint(tensors_fingerprint(policy.state_dict()), sizes)
    identity = {"method": str(text), "number": number, "policy": fingerprint}
    method = TOKEN_METHODS[parse_token_method(text).name]
    if method.settings is not None:
        identity["options"] = settings_of(text, settings)
        if number is not None:  # which takes the place of a calibrated one
            identity["options"].pop(method.number, None)
    if method.controller is not None:
        identity["controller"] = dict(settings.get("controller", {}))
    return identity


def matching_share(
    make: Callable[[float], TokenPruner],
    policy: VLAPolicy,
    episodes: Iterable[Sequence[TensorDictBase]],
    kept: float,
    *,
    most: float = 1.0,
) -> float:
    """Find the share at which a pruner keeps ``kept`` visual tokens per decoder layer, mean over layers and policy calls.

    Args:
        make: called with a share in (0, 1]; more of it keeps more.
        episodes: their calls, as `recorded_queries` yields them.
        kept: that many.
        most: the largest share that is tried.

    Raises:
        InputError: if even the smallest share keeps more.
    """
    episodes = list(episodes)

    def keeps(share: float) -> float:
        answers = [replay(policy, queries, make(share)) for queries in episodes]
        return torch.cat([answer[keys.KEPT] for answer in answers]).mean().item()

    low, high = most * 2.0**-_HALVINGS, most
    if (least := keeps(low)) > kept:
        raise InputError(
            f"pruner: expected one that can keep as few as {kept:.1f} visual tokens, got at least {least:.1f}"
        )
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if keeps(middle) <= kept else (low, middle)
    return low


@torch.no_grad()
def prepared_queries(policy: VLAPolicy, queries: Sequence[TensorDictBase]) -> list[TensorDictBase]:
    """Return an episode's policy calls, each [], with the carried keys of the previous call, so each can be run by itself."""
    remembered = [key for key in policy.out_keys if key in policy.in_keys]
    left = replay(policy, queries, policy.pruner).select(*remembered)[:-1]
    first, *others = (query.exclude(*remembered) for query in queries)
    return [first, *(query.update(before) for query, before in zip(others, left, strict=True))]


def seen_images(policy: VLAPolicy, step: TensorDictBase) -> Tensor:
    """Return the images of one step as the network gets them, cropped, u8 [V, 3, h, w]."""
    config = policy.network.config
    images = torch.stack([keys.read(step, camera) for camera in config.cameras])
    return center_crop(images, config.crop_area)
