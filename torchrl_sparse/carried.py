"""State that a module carries in the TensorDict from one call to the next, and its entries in an environment's spec.

A key is *carried* if it is in a module's ``in_keys`` and in its ``out_keys``. An environment need not hand back what it does
not know: TorchRL's `ParallelEnv` hands back the keys of its spec alone. So a module says what one environment's entries are::

    def carried(self, chunk):  # chunk: the entry of ("vla_action", "chunk"), None where nobody knows its shape
        return {("control", "step"): Entry((1,), torch.int64)}

and `ChunkExecutor.make_tensordict_primer` makes of all of them the transform that declares them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.names import did_you_mean

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = [
    "COUNT",
    "FLAG",
    "Entry",
    "TensorKeys",
    "carried_entries",
    "carried_keys",
    "check_carried",
    "dense",
    "make_primer",
    "refuse",
]


class Entry(NamedTuple):
    """Spec of a carried key for one environment, and its value at the start of an episode."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32
    begin: float = 0.0


COUNT, FLAG = Entry((1,), torch.int64), Entry((1,), torch.bool)


def carried_keys(module: TensorDictModuleBase) -> list[NestedKey]:
    """Return the keys that ``module`` carries from call to call."""
    written = {unravel_key(key) for key in module.out_keys}
    return [key for key in map(unravel_key, module.in_keys) if key in written]


def carried_entries(module: nn.Module, chunk: Entry | None) -> dict[NestedKey, Entry]:
    """Return the specs of all keys that ``module`` and its submodules carry."""
    found: dict[NestedKey, Entry] = {}
    for part in module.modules():
        if callable(tell := getattr(part, "carried", None)):
            found.update(tell(chunk))
    return found


def make_primer(entries: Mapping[NestedKey, Entry]) -> TensorDictPrimer:
    """Return a transform that adds the keys to the spec of an environment of any batch size."""
    from torchrl.data import Categorical, Composite, Unbounded  # which a robot's loop does without
    from torchrl.envs import TensorDictPrimer

    specs = Composite()
    for key, (shape, dtype, _) in entries.items():
        truth = dtype == torch.bool
        specs[key] = Categorical(2, shape, dtype=dtype) if truth else Unbounded(shape, dtype=dtype)
    begin = {key: entry.begin for key, entry in entries.items()}
    return TensorDictPrimer(specs, default_value=begin, expand_specs=True)


def check_carried(tensordict: TensorDictBase, wanted: Iterable[NestedKey], going_on: Tensor) -> None:
    """Raise InputError if a row in mid-episode lacks an entry carried from the previous step.

    Args:
        tensordict: [*B].
        wanted: carried keys.
        going_on: bool [*B, 1], the rows in mid-episode.
    """
    for key in wanted:
        if tensordict.get(key, None) is None:
            refuse(key, _lacks(tensordict, key) & going_on)


def dense(tensordict: TensorDictBase, module: TensorDictModuleBase) -> TensorDictBase:
    """Return ``tensordict``, or for a lazy stack a TensorDict with the same entries, each one tensor.

    An asynchronous collector stacks rows lazily where their keys differ. What a lazy stack hands out is a copy, so that writing
    into it is lost, and its repeated rows are one and the same. Rows without a key that ``module`` carries, at their first
    step, get zeros.

    Raises:
        KeyError: if only some of the rows have any other key.
    """
    if not isinstance(tensordict, LazyStackedTensorDict):
        return tensordict
    rows, whole = tensordict.tensordicts, tensordict.contiguous()
    for key in carried_keys(module):
        if whole.get(key, None) is None and any(row.get(key, None) is not None for row in rows):
            whole.set(key, keys.recall(tensordict, key, (), 0))
    for row in rows:
        if lacking := set(row.keys(True, True)) - set(whole.keys(True, True)):
            raise KeyError(
                f"expected {min(lacking, key=str)!r} in all of {len(rows)} rows or in none, got it in some"
            )
    return whole


def refuse(key: NestedKey, lost: Tensor) -> None:
    """Raise InputError if any of the rows ``lost``, bool [*B, 1], is True: the environment dropped ``key``."""
    if lost.any():
        raise InputError(
            f"{key}: expected what the step before left, since 'is_init' is False, got none in {int(lost.sum())} of "
            f"{lost.numel()} rows: the environment drops it; wrap it, TransformedEnv(env, actor.make_tensordict_primer()), "
            "or have the collector do so, auto_register_policy_transforms=True"
        )


def _lacks(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return bool [*B, 1], the rows without an entry; an asynchronous collector stacks rows of different keys."""
    if isinstance(rows := getattr(tensordict, "tensordicts", None), list):
        return torch.stack([_lacks(row, key) for row in rows], tensordict.stack_dim)
    missing = tensordict.get(key, None) is None
    return torch.full((*tensordict.batch_size, 1), missing, device=tensordict.device)


class TensorKeys:
    """Mixin that renames the keys that a module reads or writes, as a TorchRL loss does.

    Attributes:
        tensor_keys: what may be renamed, and the key that each has.
    """

    tensor_keys: ClassVar[Mapping[str, NestedKey]]

    def set_keys(self, **names: NestedKey | None) -> None:
        """Rename keys; None restores the default.

        Raises:
            InputError: for what has no key here; nothing is changed.
        """
        defaults = type(self).tensor_keys
        for name in names:
            if name not in defaults:
                guess = did_you_mean(name, defaults)
                raise InputError(f"set_keys: expected some of {', '.join(defaults)}, got {name!r}{guess}")
        given = {name: unravel_key(key or defaults[name]) for name, key in names.items()}
        vars(self)["tensor_keys"] = {**self.tensor_keys, **given}
