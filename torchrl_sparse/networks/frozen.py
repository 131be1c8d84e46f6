"""Write protection of weights: every PyTorch write raises, so that values derived from them stay valid without checks.

Parameters, buffers and all tensors that share their memory get a class that refuses in-place writes, and the dictionaries in
which modules hold them refuse replacements. What was taken of them before has none of their memory: they are moved. It still
counts its writes together with them, so that these are found in the next policy call, where an error says what they missed.

Not refused is what goes around PyTorch: a storage's bytes, and addresses handed to other languages.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Hashable, Iterable
from operator import attrgetter
from typing import Any, TypeVar
from weakref import ref

import numpy as np
import torch
from torch import Tensor, nn

__all__ = ["Frozen", "FrozenError"]

T = TypeVar("T")
_VERSION = attrgetter("_version")
_plainly = torch._C.DisableTorchFunctionSubclass
_HARMLESS = {"requires_grad_", "retain_grad"}
_HARMLESS_SETTERS = {"grad", "requires_grad"}


class FrozenError(RuntimeError):
    """Error for a write to weights that ``policy.freeze()`` protects."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name}: frozen by policy.freeze(); change copy.deepcopy(policy), which is not")


class Frozen:
    """Write protection of a module's parameters and buffers, from construction on; :meth:`of` returns a module's.

    Args:
        module: whose weights to freeze; copies and pickles of it are not frozen.
        name: of the module, for errors.

    Examples:
        >>> network = nn.Linear(2, 2)
        >>> frozen = Frozen(network, "network")
        >>> network.bias.data.zero_()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        torchrl_sparse.networks.frozen.FrozenError: network.bias: frozen by policy.freeze(); change copy.deepcopy(policy), ...
    """

    def __init__(self, module: nn.Module, name: str) -> None:
        members = [*module.named_parameters(prefix=name), *module.named_buffers(prefix=name)]
        self._made: dict[Hashable, Any] = {}
        with torch.inference_mode(False), torch.no_grad():
            self._names, self._counted = [], []
            for path, tensor in members:
                if not tensor.is_inference():  # those count no versions
                    tensor.data = tensor.data.clone(memory_format=torch.preserve_format)
                    self._names.append(path)
                    self._counted.append(tensor.detach())
                tensor.__class__ = FrozenParameter if isinstance(tensor, nn.Parameter) else FrozenTensor
                tensor.__dict__["_path"] = path
        self._refs = [ref(tensor) for _, tensor in members]  # with one of them, swap_tensors refuses
        self._versions = [*map(_VERSION, self._counted)]
        for path, part in module.named_modules(prefix=name):
            for held in ("_parameters", "_buffers", "_modules"):
                part.__dict__[held] = FrozenDict(part.__dict__[held], path, self)
            part.register_load_state_dict_pre_hook(_refuse_to_load)

    @staticmethod
    def of(module: nn.Module) -> Frozen | None:
        """Return the write protection of ``module``, or None."""
        return getattr(module._parameters, "frozen", None)

    def check(self) -> None:
        """Raise FrozenError, naming the weight, if it was written through a reference taken before it was frozen."""
        versions = [*map(_VERSION, self._counted)]
        if versions != self._versions:
            pairs = zip(self._names, versions, self._versions, strict=True)
            raise FrozenError(next(name for name, now, before in pairs if now != before))

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of ``make`` from its first call under this key."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


class FrozenDict(dict):
    """Parameters, buffers or submodules of a frozen module; copies and pickles are plain dictionaries."""

    def __init__(self, members: dict, path: str, frozen: Frozen) -> None:
        super().__init__(members)
        self.path, self.frozen = path, frozen

    def _refuse(self, name: Any = "", *args: Any, **members: Any) -> Any:
        raise FrozenError(f"{self.path}.{name}" if name and isinstance(name, str) else self.path)

    def __setitem__(self, name: str, member: Any) -> None:
        if name not in self or self[name] is not member:  # `module.to` puts back what stays
            self._refuse(name)

    __delitem__ = pop = setdefault = _refuse
    update = clear = popitem = __ior__ = _refuse  # type: ignore[assignment]

    def __reduce__(self) -> tuple:
        return dict, (dict(self),)

    def __reduce_ex__(self, protocol: Any) -> tuple:
        return self.__reduce__()

    def copy(self) -> dict:
        return dict(self)


class FrozenTensor(Tensor):
    """A buffer, or a tensor that shares a weight's memory; read-only."""

    @classmethod
    def __torch_function__(
        cls, func: Callable, types: Iterable[type], args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = kwargs or {}
        with _plainly():
            if (
                getattr(func, "__name__", "") == "__dlpack__"
            ):  # another library would write to what it is handed
                args = (args[0].clone(), *args[1:])
            for target in _written(func, args, kwargs):
                if isinstance(target, FrozenTensor | FrozenParameter):
                    raise FrozenError(target.__dict__.get("_path", "weights"))
            result = func(*args, **kwargs)
            if isinstance(result, Tensor | tuple | list | np.ndarray):
                held = [arg for arg in args if isinstance(arg, FrozenTensor | FrozenParameter)]
                return _guarded(result, held)
        return result

    def set_(self, *args: Any, **kwargs: Any) -> Any:  # which PyTorch does not ask __torch_function__ about
        raise FrozenError(self.__dict__.get("_path", "weights"))

    def __deepcopy__(self, memo: dict) -> Tensor:
        with _plainly():
            copied = self.as_subclass(Tensor).detach().clone().requires_grad_(self.requires_grad)
        memo[id(self)] = copied
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        # A copy: to share memory with other processes, pickling would move what is frozen.
        return self.__deepcopy__({}).__reduce_ex__(protocol)


class FrozenParameter(nn.Parameter):
    """A read-only parameter; its copies and pickles are writable."""

    __torch_function__ = FrozenTensor.__torch_function__
    set_ = FrozenTensor.set_

    def __deepcopy__(self, memo: dict) -> nn.Parameter:
        with _plainly():
            copied = nn.Parameter(self.as_subclass(Tensor).detach().clone(), self.requires_grad)
        memo[id(self)] = copied
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        copied = self.__deepcopy__({})
        return nn.Parameter, (copied.detach(), copied.requires_grad)


def _written(func: Callable, args: tuple, kwargs: dict) -> list:
    """Return the tensors that ``func`` writes to: by PyTorch's rule, its name says so."""
    name = getattr(func, "__name__", "").split(".")[0]
    if name == "__set__":
        harmless = getattr(getattr(func, "__self__", None), "__name__", "") in _HARMLESS_SETTERS
        return [] if harmless or _stays(*args) else [args[0]]
    in_place = name.endswith("_") and not name.endswith("__") and name not in _HARMLESS
    dunder = name == "__setitem__" or (name.startswith("__i") and hasattr(operator, f"__{name[3:]}"))
    in_place = in_place or dunder or kwargs.get("inplace") is True
    written = [*args, *kwargs.values()][:1] if in_place else []
    written.append(kwargs.get("out"))
    return [part for each in written for part in (each if isinstance(each, tuple | list) else [each])]


def _stays(tensor: Tensor, data: Tensor) -> bool:
    """Return whether assigning ``data`` changes nothing, as where `module.to` finds everything as it should be."""
    layouts = [
        (t.data_ptr(), t.dtype, t.device, t.shape, t.stride())
        for t in (tensor, data)
        if isinstance(t, Tensor)
    ]
    return len(layouts) == 2 and layouts[0] == layouts[1]


def _guarded(result: Any, held: list[Tensor]) -> Any:
    """Return a function's result such that no write through it can reach the tensors ``held`` by its arguments."""
    if isinstance(result, np.ndarray):
        result.flags.writeable = False
    elif isinstance(result, tuple | list) and any(isinstance(part, Tensor) for part in result):
        parts = [_guarded(part, held) for part in result]
        return parts if isinstance(result, list) else tuple(parts)
    elif isinstance(result, Tensor) and not isinstance(result, FrozenTensor | FrozenParameter):
        for tensor in held:
            if _storage(result) == _storage(tensor):
                guarded = result.as_subclass(FrozenTensor)
                guarded.__dict__["_path"] = tensor.__dict__["_path"]
                return guarded
    return result


def _storage(tensor: Tensor) -> int | None:
    return tensor.untyped_storage().data_ptr() if tensor.layout == torch.strided else None


def _refuse_to_load(module: nn.Module, state_dict: dict, prefix: str, *args: Any) -> None:
    """Refuse before PyTorch does, weight by weight; a copy of a frozen module keeps this hook and may be written."""
    if isinstance(module._parameters, FrozenDict):
        raise FrozenError(module._parameters.path)
