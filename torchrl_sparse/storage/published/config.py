"""Configurations in published checkpoints: OmegaConf objects in a pickle, read as data.

References to other entries (``${task.obs_dim}``) are followed. Expressions (``${eval:'...'}``,
``${now:...}``) are text that is never evaluated.
"""

from __future__ import annotations

import re
from functools import partial
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.published.inert_pickle import PLAIN, Name, Record

__all__ = ["KNOWN_NAMES", "PublishedConfig"]

_NODES = ("AnyNode", "StringNode", "IntegerNode", "FloatNode", "BooleanNode")
_CONTAINERS = {"omegaconf.dictconfig.DictConfig": dict, "omegaconf.listconfig.ListConfig": list}
_RECORDS = [
    *_CONTAINERS,
    *(f"omegaconf.nodes.{node}" for node in _NODES),
    *("omegaconf.base.Metadata", "omegaconf.base.ContainerMetadata"),
]
_TYPES = [f"builtins.{name}" for name in ("dict", "list", "tuple", "str", "int", "float", "bool", "object")]

KNOWN_NAMES = {
    **PLAIN,
    **{name: partial(Record, name) for name in _RECORDS},
    # Types appear where OmegaConf notes what an entry may hold.
    **dict.fromkeys(["typing.Any", *_TYPES]),
    **{f"dill.{module}._load_type": Name for module in ("_dill", "dill")},
}
"""Classes that a pickled configuration may name, for `read_pickle`."""

_REFERENCE = re.compile(r"\$\{([\w.]+)\}")
_MAX_DEPTH = 32
_MAX_TEXT, _MAX_NAMES = 1000, 64
_REQUIRED = object()


class PublishedConfig:
    """Configuration entries by dotted path.

    Args:
        tree: what `read_pickle` found: records of OmegaConf objects, or plain containers.

    Raises:
        InputError: if it is no configuration.

    Examples:
        >>> config = PublishedConfig({"n_obs_steps": 2, "policy": {"steps": "${n_obs_steps}"}})
        >>> config.get("policy.steps", int)
        2
    """

    def __init__(self, tree: Any) -> None:
        self._tree = _plain(tree, {}, _MAX_DEPTH)
        self._found: dict[str, Any] = {}
        if not isinstance(self._tree, dict):
            raise InputError(f"cfg: expected a configuration, got {type(tree).__name__}")

    def get(self, path: str, kind: type, default: Any = _REQUIRED) -> Any:
        """Return the entry at ``path`` with references resolved.

        Args:
            path: keys joined by dots.
            kind: type of the entry; float also takes integers.
            default: what to return if there is none, or None is there; required without.

        Raises:
            InputError: if the entry is missing, of another type, or an expression.
        """
        value = self._find(path, _MAX_DEPTH)
        if value is None:
            if default is _REQUIRED:
                raise InputError(f"cfg: expected an entry {path}, got none")
            return default
        if isinstance(value, str) and "${" in value:
            raise InputError(
                f"cfg: {path}: expected a value, got the expression {value[:80]!r}: none is evaluated"
            )
        if isinstance(value, str) and len(value) > _MAX_TEXT:
            raise InputError(f"cfg: {path}: expected at most {_MAX_TEXT} characters, got {len(value)}")
        accepted = (int, float) if kind is float else kind
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise InputError(f"cfg: {path}: expected {kind.__name__}, got {type(value).__name__}")
        return value

    def names(self, path: str) -> list[str] | None:
        """Return the items of the list, or the keys of the dict, at ``path``; None if there is neither.

        Raises:
            InputError: if there are too many, or it holds anything but names.
        """
        found = self._find(path, _MAX_DEPTH)
        if found is None:
            return None
        plain = isinstance(found, (list, dict)) and len(found) <= _MAX_NAMES and all(map(_is_name, found))
        if not plain:
            raise InputError(f"cfg: {path}: expected at most {_MAX_NAMES} names, got {type(found).__name__}")
        return list(found)

    def literal(self, path: str, kind: type) -> Any:
        """Return the entry at ``path``; None if it is missing or an expression; errors as in `get`."""
        found = self._find(path, _MAX_DEPTH)
        return None if isinstance(found, str) and "${" in found else self.get(path, kind, None)

    def value(self, path: str) -> Any:
        """Return the value at ``path``, of any type; None if it is missing."""
        return self._find(path, _MAX_DEPTH)

    def _find(self, path: str, depth: int) -> Any:
        """Return the entry at ``path``; what was found is kept, or references to references would multiply."""
        if path.count(".") > _MAX_DEPTH:
            raise InputError(f"cfg: {path[:80]}: expected a path of at most {_MAX_DEPTH} levels")
        if path not in self._found:
            node: Any = self._tree
            for key in path.split("."):
                node = self._follow(node.get(key) if isinstance(node, dict) else None, path, depth)
            self._found[path] = node
        return self._found[path]

    def _follow(self, node: Any, path: str, depth: int) -> Any:
        reference = _REFERENCE.fullmatch(node) if isinstance(node, str) else None
        if reference is None:
            return node
        if depth == 0:
            raise InputError(f"cfg: {path}: expected a value, got references that go round in a circle")
        return self._find(reference.group(1), depth - 1)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEXT and "${" not in value


def _plain(node: Any, done: dict[int, Any], depth: int) -> Any:
    """Unfold dicts, lists and values; ``done`` keeps a node that is mentioned many times from being unfolded each time."""
    if depth == 0:
        raise InputError(f"cfg: expected a configuration of at most {_MAX_DEPTH} levels")
    if id(node) not in done:
        if isinstance(node, Record):
            inner = _content(node)
            done[id(node)] = _plain(inner, done, depth - 1)
        elif isinstance(node, dict):
            done[id(node)] = {key: _plain(value, done, depth - 1) for key, value in node.items()}
        elif isinstance(node, list):
            done[id(node)] = [_plain(value, done, depth - 1) for value in node]
        elif isinstance(node, (str, int, float, type(None))):
            return node
        else:
            raise InputError(f"cfg: expected plain values, got {type(node).__name__}")
    return done[id(node)]


def _content(record: Record) -> Any:
    if record.name.startswith("omegaconf.nodes."):
        return record.state.get("_val")
    kind = _CONTAINERS.get(record.name)
    content = record.state.get("_content")
    # A container can also be None or, as a whole, a reference.
    if kind is None or not isinstance(content, (kind, str, type(None))):
        raise InputError(f"cfg: expected containers and values of OmegaConf, got {record.name}")
    return content
