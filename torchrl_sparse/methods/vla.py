"""The methods of a vision-language-action policy by name: pruner, controller, and colour in figures.

A method is a `MethodSpec` or its label: ``NAME``, ``NAME@NUMBER`` or ``NAME@METHOD``.
NAME is a key of :data:`TOKEN_METHODS`; NUMBER is the argument
that the method is tuned by, such as SpecPrune's alpha or the share of tokens that stays; METHOD is another method, of which as
many tokens are kept: ``fastv@specprune@0.4``.

A method of one's own is one line, executed before its name is used::

    TOKEN_METHODS["mine"] = TokenMethod(MyPruner, number="share")
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.spec import MethodSpec
from torchrl_sparse.runtime.names import did_you_mean
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.dense_first import DenseFirst
from torchrl_sparse.tokens.efficientvla import EfficientVLAPruner
from torchrl_sparse.tokens.fastv import FastVPruner
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.sparsevlm import SparseVLMPruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.tokens.vla_cache import VLACachePruner

__all__ = [
    "TOKEN_METHODS",
    "TokenMethod",
    "check_matches",
    "make_controller",
    "make_pruner",
    "parse_token_method",
]

Settings = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class TokenMethod:
    """One entry of the method table: how a method is made, controlled and drawn.

    Attributes:
        make: called with keyword arguments; returns the pruner, or None for the dense policy.
        number: the argument of ``make`` that NAME@NUMBER sets; None where there is none.
        matches: whether NAME@METHOD may be written: its number is a share in (0, 1], of which more keeps more tokens.
        settings: the section of a benchmark's settings whose entries are further arguments of ``make``; None for none.
        controller: called with the section ``controller`` of the settings as keyword arguments; returns what a
            `ChunkExecutor` runs at every step beside the policy. None for nothing.
        color: in figures, such as ``"#0072B2"``; None takes what is left.
    """

    make: Callable[..., TokenPruner | None]
    number: str | None = None
    matches: bool = False
    settings: str | None = None
    controller: Callable[..., TensorDictModuleBase] | None = None
    color: str | None = None


def _dense() -> None:
    return None


def _specprune(fixed: dict[str, Any], **options: Any) -> SpecPrune:
    return SpecPrune(**options | fixed)


def _dense_first(make: Callable[..., TokenPruner], share: float = 0.5) -> DenseFirst:
    return DenseFirst(make(share))


def _variant(color: str, **fixed: Any) -> TokenMethod:
    """Return SpecPrune with its controller, and with these options whatever the settings say."""
    return TokenMethod(
        partial(_specprune, fixed),
        "alpha",
        matches=True,
        settings="specprune",
        controller=ActionAwareController.from_options,
        color=color,
    )


TOKEN_METHODS: dict[str, TokenMethod] = {
    "dense": TokenMethod(_dense, color="#333333"),
    "specprune": TokenMethod(
        SpecPrune,
        "alpha",
        settings="specprune",
        controller=ActionAwareController.from_options,
        color="#009E73",
    ),
    "specprune_uncontrolled": TokenMethod(SpecPrune, "alpha", settings="specprune", color="#8C6BB1"),
    "specprune_static": TokenMethod(
        partial(_specprune, {"dynamic": False}), "alpha", settings="specprune", color="#A6761D"
    ),
    "specprune_look_back": _variant("#B3CDE3", look_back=4),
    "specprune_no_carry": _variant("#74A9CF", carry=False),
    "specprune_no_changed": _variant("#F46D43", changed=False),
    "specprune_no_local": _variant("#3F2A8C", local=False),
    "frame_difference": TokenMethod(FrameDifferencePruner, "share", matches=True, color="#B2182B"),
    "fastv": TokenMethod(FastVPruner, "share", matches=True, color="#4D4D4D"),
    "fastv_scaled": TokenMethod(partial(FastVPruner, depth=32), "share", matches=True, color="#9E9AC8"),
    "fastv_dense_first": TokenMethod(
        partial(_dense_first, FastVPruner), "share", matches=True, color="#7A4B2A"
    ),
    "random": TokenMethod(RandomPruner, "share", matches=True, color="#66A61E"),
    "random_dense_first": TokenMethod(
        partial(_dense_first, RandomPruner), "share", matches=True, color="#00441B"
    ),
    "efficientvla": TokenMethod(EfficientVLAPruner, "share", matches=True, color="#E7298A"),
    "efficientvla_dense_first": TokenMethod(
        partial(_dense_first, EfficientVLAPruner), "share", matches=True, color="#FB9A99"
    ),
    "efficientvla_layers": TokenMethod(EfficientVLAPruner, "share", matches=True, settings="efficientvla"),
    "vla_cache": TokenMethod(VLACachePruner, "static_share", color="#1B7F79"),
    "sparsevlm": TokenMethod(SparseVLMPruner, "scale", color="#BCBD22"),
    "sparsevlm_embeddings": TokenMethod(partial(SparseVLMPruner, raters="embeddings"), "scale"),
}
"""Name -> method. ``specprune`` runs with the controller; ``specprune_uncontrolled`` (static and dynamic pruning) and
``specprune_static`` are its ablations, and so are, with the controller, those that lack one of the sets of Eq. 6.
``specprune_look_back`` compares a slow hand's pictures with older ones.
``..._dense_first`` leaves an episode's first policy call dense, as SpecPrune and frame difference do. ``fastv`` prunes after
two layers, ``fastv_scaled`` after as many as two of 32 are at the model's depth. ``efficientvla`` is its half that is about
tokens, ``efficientvla_layers`` skips layers too. ``sparsevlm`` chooses the words that rate tokens in each layer,
``sparsevlm_embeddings`` once, as the authors' release."""


def parse_token_method(method: MethodSpec | str) -> MethodSpec:
    """Parse the label of a method in the table; InputError if it is unknown or has unsupported parts.

    >>> parse_token_method("random@specprune@0.4").like
    'specprune@0.4'
    """
    written = MethodSpec.parse(method)
    name, rates, like = written.name, written.rates, written.like
    if (known := TOKEN_METHODS.get(name)) is None:
        guess = did_you_mean(name, TOKEN_METHODS)
        raise InputError(f"methods: expected one of {', '.join(TOKEN_METHODS)}, got {str(method)!r}{guess}")
    takes = [] if known.number is None else [f"{name}@NUMBER"], [f"{name}@METHOD"] * known.matches
    executed = replace(written, rates=(), like=None) != MethodSpec.parse(name)
    if executed or len(rates) > len(takes[0]) or (like is not None and not known.matches):
        raise InputError(
            f"methods: expected {' or '.join([name, *takes[0], *takes[1]])}, got {str(method)!r}"
        )
    if like is not None:
        parse_token_method(like)
    return written


def check_matches(texts: Iterable[str]) -> None:
    """Raise InputError if a method matches one that is not among ``texts``, or that itself matches another.

    >>> check_matches(["dense", "fastv@specprune"])
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: methods: fastv@specprune: expected one of dense after @, got 'specprune'
    """
    like = {text: parse_token_method(text).like for text in texts}
    plain = [text for text, matched in like.items() if matched is None]
    for text, matched in like.items():
        if matched is not None and matched not in plain:
            raise InputError(f"methods: {text}: expected one of {', '.join(plain)} after @, got {matched!r}")


def make_pruner(
    method: MethodSpec | str, *, number: float | None = None, settings: Settings | None = None
) -> TokenPruner | None:
    """Return the pruner of a method; None for the dense policy.

    Args:
        method: as the module says.
        number: takes the place of the one that is written, where another method is matched.
        settings: sections of further arguments, see `TokenMethod`.

    Raises:
        InputError: for a number that the method does not take.

    Examples:
        >>> make_pruner("specprune@0.8", settings={"specprune": {"budget": 20.0}}).options.alpha
        0.8
    """
    written = parse_token_method(method)
    entry, arguments = TOKEN_METHODS[written.name], settings_of(written, settings)
    for value in written.rates if number is None else (number,):
        if entry.number is None:
            raise InputError(f"number: expected none for {written.name}, got {value}")
        arguments[entry.number] = value
    return entry.make(**arguments)


def make_controller(
    method: MethodSpec | str, settings: Settings | None = None
) -> TensorDictModuleBase | None:
    """Return the controller of a method; None if it has none.

    Args:
        method: as the module says.
        settings: with its arguments under ``controller``.

    Examples:
        >>> make_controller("specprune", {"controller": {"fine": 36.0}}).budgets
        (24.0, 36.0)
    """
    make = TOKEN_METHODS[parse_token_method(method).name].controller
    return None if make is None else make(**(settings or {}).get("controller", {}))


def settings_of(method: MethodSpec | str, settings: Settings | None) -> dict[str, Any]:
    """Return the section of ``settings`` that a method reads; empty if it reads none."""
    section = TOKEN_METHODS[parse_token_method(method).name].settings
    return {} if section is None else dict((settings or {}).get(section, {}))
