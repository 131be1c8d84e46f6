"""Archives in the form of ``torch.save`` that say of their tensors whatever a test wants them to say."""

import io
import math
import pickle
import zipfile
from dataclasses import dataclass

import torch
from omegaconf import OmegaConf

from .checkpoints import LowDimPolicy, low_dim_config


@dataclass(frozen=True)
class Storage:
    """A reference to the record ``data/<record>``, which is said to hold ``numel`` f32."""

    record: str
    numel: int


@dataclass(frozen=True)
class Entry:
    """A tensor as a pickle describes it."""

    storage: Storage
    shape: tuple
    stride: tuple

    def __reduce__(self):
        return torch._utils._rebuild_tensor_v2, (self.storage, 0, self.shape, self.stride, False, {})


def entry(shape, record="0", numel=None):
    """A contiguous tensor, by default one whose storage is said to have its size."""
    stride = tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))
    return Entry(Storage(record, math.prod(shape) if numel is None else numel), tuple(shape), stride)


class _Pickler(pickle._Pickler):
    def persistent_id(self, value):
        if isinstance(value, Storage):
            return "storage", torch.FloatStorage, value.record, "cpu", value.numel
        return None


def write_archive(path, payload, records):
    """Write ``payload``, or a pickle that is given as it is, with the bytes of each record."""
    data = payload if isinstance(payload, bytes) else _pickled(payload)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", data)
        for name, content in records.items():
            archive.writestr(f"archive/data/{name}", content)
    return path


def _pickled(payload):
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=2).dump(payload)
    return buffer.getvalue()


def true_payload(**sizes):
    """A payload of plain containers and entries, and its records: a checkpoint that can be read."""
    policy = LowDimPolicy(**sizes)
    names = {name: str(number) for number, name in enumerate(policy.state_dict())}
    records = {names[name]: value.numpy().tobytes() for name, value in policy.state_dict().items()}
    tensors = {name: entry(value.shape, names[name]) for name, value in policy.state_dict().items()}
    config = OmegaConf.to_container(low_dim_config(policy))
    return {"cfg": config, "state_dicts": {"ema_model": tensors}, "pickles": {}}, records
