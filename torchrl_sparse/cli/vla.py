"""The options with which recipes load a vision-language-action policy."""

from __future__ import annotations

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.published.openvla_oft import is_openvla_oft

__all__ = ["load_vla"]

_UNSAID = ("cameras", "heads", "chunk_size", "normalization", "center_crop")


def load_vla(config: DictConfig, data_set: str) -> VLAPolicy:
    """Load the folder ``config.policy``, with those options that the files of a published one do not say.

    Args:
        config: of a recipe. ``published`` holds arguments of `VLAPolicy.from_openvla_oft`; null ones are the published values.
        data_set: whose statistics normalise a published policy's actions.

    Raises:
        FileNotFoundError, ValueError: as of `VLAPolicy.from_pretrained`; also for options that a folder does not need.
    """
    options = {"heads": config.heads} | OmegaConf.to_container(config.published)
    if unknown := options.keys() - {*_UNSAID}:
        raise ValueError(
            f"published: expected some of {', '.join(_UNSAID)}, got {', '.join(sorted(unknown))}"
        )
    given = {name: value for name, value in options.items() if value is not None}
    if is_openvla_oft(config.policy):
        given["unnorm_key"] = data_set
    return VLAPolicy.from_pretrained(config.policy, base=config.get("base"), **given)
