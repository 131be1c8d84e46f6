"""Construction of an untrained vision-language-action policy that fits the demonstrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.adapters import add_adapters
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.rotations import ABSOLUTE_DIM
from torchrl_sparse.storage.json import describe_differences
from torchrl_sparse.storage.language_model import LanguageModel, load_base, read_language_model
from torchrl_sparse.storage.vla import AdaptedBase
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations

__all__ = ["check_sizes", "untrained_policy"]

_SIZES = {"tiny": VLAConfig.tiny, "small": VLAConfig.small, "published": VLAConfig}


def untrained_policy(
    demos: InstructedDemonstrations,
    size: str,
    *,
    cameras: Sequence[str],
    changes: Mapping[str, Any] | None = None,
    seed: int = 0,
    base: str | Path | None = None,
    rank: int = 16,
) -> VLAPolicy:
    """Return an untrained policy with the demonstrations' inputs, outputs, vocabulary and normaliser.

    Args:
        demos: decide the sizes of state, action and images, the words and the normaliser.
        size: ``"tiny"``, ``"small"`` or ``"published"``, see `VLAConfig`.
        cameras: names of the images that the policy observes.
        changes: fields of `VLAConfig`, nested as there, that shall differ from those of ``size``.
        seed: of the weights.
        base: file of the language model that is the decoder, adapted; None for one with random weights.
        rank: of the adapters.

    Raises:
        InputError: for another size, or a file that is no language model.
    """
    data = demos.episodes.data
    action = data[keys.ACTION]
    grippers = range(ABSOLUTE_DIM - 1, action.shape[-1], ABSOLUTE_DIM)
    normalizer = QuantileNormalizer.fit(data[keys.STATE], action, gripper=grippers)
    config = _fitting_config(demos, size, cameras, changes or {})
    torch.manual_seed(seed)
    if base is not None:
        return _adapting(config, normalizer, read_language_model(base), rank)
    words = sorted({word for text in demos.instructions for word in text.lower().split()})
    return VLAPolicy(VLANetwork(config), normalizer, WordTokenizer(words))


def check_sizes(
    policy: VLAPolicy,
    path: str | Path,
    *,
    size: str | None,
    rank: int | None,
    changes: Mapping[str, Any],
) -> None:
    """Raise InputError for requested sizes that differ from those of the policy to train on.

    Args:
        policy: that is trained on.
        path: its folder.
        size, rank, changes: as of `untrained_policy`; None for the policy's own.
    """
    if size is not None:
        raise InputError(f"size: expected null, since sizes are those of the policy in {path}, got {size}")
    own = None if policy.base is None else policy.base.rank
    if rank not in (None, own):
        raise InputError(f"rank: expected {own}, as of the policy in {path}, got {rank}")
    sizes = policy.network.config.to_dict()
    asked = OmegaConf.to_container(OmegaConf.merge(sizes, changes), resolve=True)
    if differing := describe_differences(sizes, asked):
        raise InputError(f"network: expected sizes of the policy in {path}, got others: {differing}")


def _adapting(
    config: VLAConfig, normalizer: QuantileNormalizer, language: LanguageModel, rank: int
) -> VLAPolicy:
    network = add_adapters(VLANetwork(replace(config, **language.sizes)), rank)
    load_base(network, language)
    policy = VLAPolicy(network, normalizer, language.tokenizer)
    policy.base = AdaptedBase(language.sha256, rank)
    return policy


def _fitting_config(
    demos: InstructedDemonstrations, size: str, cameras: Sequence[str], changes: Mapping[str, Any]
) -> VLAConfig:
    if size not in _SIZES:
        raise InputError(f"size: expected one of {', '.join(_SIZES)}, got {size!r}")
    data, camera_keys = demos.episodes.data, [["observation", name] for name in cameras]
    decided = {
        "cameras": camera_keys,
        "image_size": data[tuple(camera_keys[0])].shape[-1],
        "state_dim": data[keys.STATE].shape[-1],
        "action_dim": data[keys.ACTION].shape[-1],
    }
    fields = OmegaConf.merge(_SIZES[size]().to_dict(), changes, decided)
    return VLAConfig.from_dict(OmegaConf.to_container(fields, resolve=True))
