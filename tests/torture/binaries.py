"""Files that are not JSON, and what can be wrong inside them: tensors, demonstrations, published checkpoints, sweeps."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml
from safetensors.torch import load_file, save_file

from tests.data.test_robomimic import write as write_demos
from tests.storage.published.checkpoints import LowDimPolicy, put_config, write_checkpoint
from tests.torture.formats import SWEEP, small_policy, small_pruner
from tests.torture.grammar import OUT_OF_BOUNDS, Change
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.cli.sweep_files import read_sweep
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

STATE_KEYS = ("object", "robot0_eef_pos")
_SIZES = ("n_layer", "n_head", "n_emb")


@dataclass(frozen=True)
class Kind:
    """A kind of file; ``changes`` yields changes whose content edits the file in place, the rest is as in `Format`."""

    name: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    file: str
    changes: Callable[[], Iterator[Change]]


# -- safetensors -------------------------------------------------------------------------------------------------------


def _tensor_changes(first: str, last: str) -> Iterator[Change]:
    """Change two tensors, of which a pruner's or a policy's file has many."""
    for name in (first, last):
        for how, change in {
            "missing": lambda value: None,
            "of another shape": lambda value: torch.zeros(3, 2),
            "longer": lambda value: torch.cat([value, value]),
            "flat": lambda value: value.flatten()[None, None],
            "empty": lambda value: value[:0],
            "not finite": lambda value: torch.full_like(value, float("nan")),
            "infinite": lambda value: torch.full_like(value, float("-inf")),
            "of integers": lambda value: value.to(torch.int32),
            "of truth values": lambda value: value.bool(),
        }.items():
            yield Change(f"{name} is {how}", name.partition(".")[2], partial(_put_tensor, name, change))
    yield Change(
        "an unknown tensor", "unheard_of", partial(_put_tensor, "unheard_of", lambda _: torch.zeros(2))
    )
    for name, header in {
        "header longer than the file": struct.pack("<Q", 2**62),
        "header of nothing": struct.pack("<Q", 0),
        "header that is text": struct.pack("<Q", 4) + b"text",
        "tensor beyond the file": _header(
            {"x": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}
        ),
        "tensor of endless shape": _header(
            {"x": {"dtype": "F32", "shape": [2**63, 2**63], "data_offsets": [0, 4]}}
        ),
        "tensors that overlap": _header(
            {n: {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]} for n in ("x", "y")}
        ),
    }.items():
        yield Change(name, "", lambda path, data=header: path.write_bytes(data + bytes(4)))


def _header(entries: dict[str, Any]) -> bytes:
    text = json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text


def _put_tensor(name: str, change: Callable, path: Path) -> None:
    tensors = load_file(path)
    value = change(tensors.get(name))
    if value is None:
        del tensors[name]
    else:
        tensors[name] = value.contiguous()
    save_file(tensors, path)


# -- demonstrations ----------------------------------------------------------------------------------------------------


def _demo_changes() -> Iterator[Change]:
    arrays = {"actions": 7, "obs/object": 2, "obs/robot0_eef_pos": 3}
    for array, width in arrays.items():
        path = f"data/demo_1/{array}"
        for how, value in {
            "a vector": np.zeros(4),
            "a number": np.float64(3),
            "a row too long": np.zeros((5, width)),
            "empty": np.zeros((0, width)),
            "without columns": np.zeros((4, 0)),
            "not finite": np.full((4, width), np.inf),
            "text": "actions",
            "strings": np.array([b"a"] * 4),
            "complex": np.zeros((4, width), dtype=np.complex64),
            "of records": np.zeros(4, dtype=[("a", "f4"), ("b", "i4")]),
        }.items():
            key = "" if how == "without columns" else "demo_1"  # whose sizes alone contradict
            yield Change(f"{array} is {how}", key, partial(_put_array, path, value))
        yield Change(f"{array} is missing", "demo_1", partial(_drop, path))
        yield Change(f"{array} is a group", "demo_1", partial(_put_group, path))
        yield Change(f"{array} is 4 billion rows of nothing", "demo_1", partial(_put_unfilled, path, width))
        yield Change(f"{array} unfolds a thousandfold", "demo_1", partial(_put_zipped, path, width))
        yield Change(f"{array} leads outside", "demo_1", partial(_put_link, path, "/etc/passwd"))
        yield Change(f"{array} leads to itself", "demo_1", partial(_put_soft, path))
    for value in (0, -1, 5, 2**62, 1.5, "four", [4, 4]):
        yield Change(f"num_samples is {value}", "demo_1", partial(_put_attribute, "num_samples", value))
    yield Change("no group data", "data", partial(_drop, "data"))
    yield Change("a demonstration is an array", "demo_1", partial(_put_array, "data/demo_1", np.zeros(3)))


def _put_array(name: str, value: Any, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = value


def _drop(name: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]


def _put_group(name: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
        file.create_group(name)


def _put_unfilled(name: str, width: int, path: Path) -> None:
    """Declare as many rows as the file says it has samples; none is stored."""
    _put_big(name, (2**32, width), {"chunks": (2**20, width)}, path)


def _put_zipped(name: str, width: int, path: Path) -> None:
    """Store gigabytes of zeros in a chunk of some kilobytes each."""
    _put_big(name, (2**27, width), {"chunks": (2**20, width), "compression": "gzip", "fillvalue": 0}, path)


def _put_big(name: str, shape: tuple[int, int], options: dict[str, Any], path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
        file.create_dataset(name, shape, dtype="f8", **options)[: 2**18] = 0
        file["data/demo_1"].attrs["num_samples"] = shape[0]


def _put_link(name: str, target: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = h5py.ExternalLink(target, "/")


def _put_soft(name: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = h5py.SoftLink(f"/{name}")


def _put_attribute(name: str, value: Any, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_1"].attrs[name] = value


# -- published checkpoints ---------------------------------------------------------------------------------------------


def _checkpoint_changes() -> Iterator[Change]:
    entries = {
        "policy._target_": ["x.Unknown", 3],
        "n_action_steps": ["8", 1.5, [8]],
        "policy.noise_scheduler.num_train_timesteps": ["100", None, *OUT_OF_BOUNDS],
        "policy.noise_scheduler.beta_schedule": ["linear", 3],
        "policy.noise_scheduler.prediction_type": ["sample", {}],
        "policy.noise_scheduler.clip_sample": [False, "yes"],
        "policy.num_inference_steps": ["100", *OUT_OF_BOUNDS],
        "policy.model.n_head": ["4", 5, None, "${eval:'4'}", *OUT_OF_BOUNDS],
        "policy.model.obs_as_cond": [False, 3],
        "horizon": [12, 10**12],
    }
    for path, values in entries.items():
        for value in values:
            edit = partial(_rewrite, put_config(path, value))
            key = (
                "" if value == OUT_OF_BOUNDS[-1] else path.rpartition(".")[2]
            )  # the pickle's reader knows no keys
            yield Change(f"cfg.{path} is {value!r}", key, edit)
    for tensor in ("model.head.bias", "model.pos_emb", "normalizer.params_dict.obs.scale"):
        key = tensor.rpartition(".")[2]
        for how, value in {
            "missing": None,
            "of another shape": torch.zeros(9),
            "not finite": torch.full((10,), float("nan")),
            "of integers": torch.zeros(10, dtype=torch.int64),
            "a list": [0.0],
            "sparse": torch.zeros(10, 10).to_sparse(),
        }.items():
            edit = partial(_rewrite, partial(_put_weight, tensor, value))
            yield Change(f"{tensor} is {how}", "" if how == "sparse" else key, edit)


def _rewrite(change: Callable, path: Path) -> None:
    write_checkpoint(path, LowDimPolicy(), change=change)


def _put_weight(name: str, value: Any, payload: dict) -> None:
    weights = payload["state_dicts"]["ema_model"]
    if value is None:
        del weights[name]
    else:
        weights[name] = value


# -- sweeps ------------------------------------------------------------------------------------------------------------


def _sweep_changes() -> Iterator[Change]:
    for key in ("program", "method", "parameters", "command"):
        for how, value in {"missing": None, "a number": 3, "a list": [1], "unknown": "unheard of"}.items():
            sweep = (
                {**SWEEP, key: value} if how != "missing" else {k: v for k, v in SWEEP.items() if k != key}
            )
            name = f"{key} is {how}"
            yield Change(
                name,
                None if (key, how) in {("program", "unknown"), ("command", "missing")} else key,
                partial(_put_text, yaml.dump(sweep)),
            )
    bomb = "\n".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]" for i in range(12)
    )
    for name, text in {
        "a word": "words",
        "a list": "[1, 2]",
        "nothing": "",
        "tabs": "method:\n\tgrid",
        "an object of Python": "!!python/object/apply:os.system ['true']",
        "aliases that unfold": f"a: &a [1, 1]\n{bomb}\nmethod: grid",
        "deep lists": "method: " + "[" * 20_000 + "]" * 20_000,
        "NUL bytes": "method: \0",
    }.items():
        yield Change(name, "", partial(_put_text, text))


def _put_text(text: str, path: Path) -> None:
    path.write_text(text)


KINDS = [
    Kind(
        "tensors of a policy",
        lambda folder: small_policy().save_pretrained(folder),
        DiffusionPolicy.from_pretrained,
        "model.safetensors",
        partial(_tensor_changes, "network.head.weight", "normalizer.state_scale"),
    ),
    Kind(
        "tensors of a pruner",
        lambda folder: small_pruner().save_pretrained(folder / "sag"),
        lambda folder: load_planner(folder / "sag"),
        "sag/pruner.safetensors",
        partial(_tensor_changes, "fuse_obs.bias", "token.weight"),
    ),
    Kind(
        "demonstrations, HDF5",
        lambda folder: write_demos(folder / "demos.h5"),
        lambda folder: read_demos(folder / "demos.h5", STATE_KEYS),
        "demos.h5",
        _demo_changes,
    ),
    Kind(
        "published checkpoint",
        lambda folder: write_checkpoint(folder / "latest.ckpt", LowDimPolicy()),
        lambda folder: DiffusionPolicy.from_diffusion_policy(folder / "latest.ckpt"),
        "latest.ckpt",
        _checkpoint_changes,
    ),
    Kind(
        "sweep, YAML",
        lambda folder: (folder / "sweep.yaml").write_text(yaml.dump(SWEEP)),
        lambda folder: read_sweep(folder / "sweep.yaml"),
        "sweep.yaml",
        _sweep_changes,
    ),
]  # fmt: skip
