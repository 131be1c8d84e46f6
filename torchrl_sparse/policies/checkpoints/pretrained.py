"""A diffusion policy as two files: ``config.json`` and ``model.safetensors``. Neither can hold anything that executes.

::

    {"format": "torchrl_sparse.diffusion_policy/1",
     "network": {arguments of TransformerForDiffusion},
     "schedule": {arguments of NoiseSchedule}}

Network weights are fp16, normalisation constants fp32.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_sparse.data.normalize import Normalizer
from torchrl_sparse.policies.checkpoints.files import read_config, read_tensors, write_config, write_tensors
from torchrl_sparse.policies.checkpoints.tensors import check_finite, check_shapes, take
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

FORMAT = "torchrl_sparse.diffusion_policy/1"
_FIELDS = {"format", "network", "schedule"}
_NETWORK, _NORMALIZER = "network.", "normalizer."


def write_pretrained(
    path: Path, *, network: TransformerForDiffusion, normalizer: Normalizer, schedule: dict[str, Any]
) -> None:
    """Writes both files into the folder ``path``, each in one piece or not at all."""
    tensors = {_NETWORK + name: value.half() for name, value in network.state_dict().items()}
    tensors |= {_NORMALIZER + name: value for name, value in normalizer.state_dict().items()}
    config = {"format": FORMAT, "network": network.config, "schedule": schedule}
    write_tensors(path / "model.safetensors", tensors)
    write_config(path / "config.json", config)


def read_pretrained(path: Path) -> tuple[TransformerForDiffusion, Normalizer, dict[str, Any]]:
    """Network (f32, eval mode), normaliser and the arguments of the schedule from the folder ``path``.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: naming the file, what was expected and what came.
    """
    config = read_config(path / "config.json", FORMAT, _FIELDS)
    tensors = read_tensors(path / "model.safetensors")
    try:
        network = TransformerForDiffusion(**config["network"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path / 'config.json'}: network: {error}") from error
    network_tensors = take(tensors, _NETWORK)
    normalizer_tensors = take(tensors, _NORMALIZER)
    expected_normalizer = {
        f"{name}_{part}": (size,)
        for name, size in (("state", network.cond_dim), ("action", network.input_dim))
        for part in ("scale", "offset")
    }
    expected_network = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    where = path / "model.safetensors"
    for prefix, found, expected in (
        (_NETWORK, network_tensors, expected_network),
        (_NORMALIZER, normalizer_tensors, expected_normalizer),
    ):
        check_shapes(f"{where}: {prefix}", found, expected)
        check_finite(f"{where}: {prefix}", found)
    if tensors:
        raise ValueError(
            f"{where}: expected tensors under {_NETWORK!r} and {_NORMALIZER!r}, got {sorted(tensors)}"
        )
    network.load_state_dict({name: value.float() for name, value in network_tensors.items()})
    return network.eval(), Normalizer(**normalizer_tensors), config["schedule"]
