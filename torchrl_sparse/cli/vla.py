"""Options with which recipes load a vision-language-action policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.json import read_json
from torchrl_sparse.storage.published.openvla_oft import is_openvla_oft

__all__ = ["is_vla", "load_vla"]

_UNSAID = ("cameras", "heads", "chunk_size", "normalization", "center_crop")


def is_vla(path: str | Path) -> bool:
    """Tell whether a folder's ``config.json`` is of a vision-language-action policy, ours or published; other files are not
    checked.

    >>> is_vla("assets/vla"), is_vla("assets/lift")
    (True, False)
    """
    config = Path(path) / "config.json"
    if not config.is_file() or is_openvla_oft(path):
        return config.is_file()
    return str(read_json(config, dict[str, Any]).get("format")).startswith("torchrl_sparse.vla_policy/")


def load_vla(config: DictConfig, data_set: str | None) -> VLAPolicy:
    """Load the folder ``config.policy``, taking from the options what a published checkpoint's files leave open.

    Args:
        config: of a recipe. ``published`` holds arguments of `VLAPolicy.from_openvla_oft`; null ones are the published values.
        data_set: whose statistics normalise a published policy's actions; None where its file has one only.

    Raises:
        FileNotFoundError, InputError: as of `VLAPolicy.from_pretrained`; also for options that a folder does not need.
    """
    options = {"heads": config.heads} | OmegaConf.to_container(config.published)
    if unknown := options.keys() - {*_UNSAID}:
        raise InputError(
            f"published: expected some of {', '.join(_UNSAID)}, got {', '.join(sorted(unknown))}"
        )
    given = {name: value for name, value in options.items() if value is not None}
    if is_openvla_oft(config.policy):
        given["unnorm_key"] = data_set
    engine = config.get("engine", "auto")
    return VLAPolicy.from_pretrained(config.policy, base=config.get("base"), engine=engine, **given)
