"""Planners: TensorDict modules that write the prune mask of a policy call, each with one reuse rule.

A planner of one's own subclasses :class:`Planner` (the mask depends on the observation) or :class:`StaticPlanner` (it
does not) and writes one method; ``policy.plan = Mine()`` is all that using it takes. One that is kept in a file gets a
line in :data:`torchrl_sparse.blocks.saved.PLANNERS`, and one that is asked for by name, as benchmarks do, a line in
:data:`torchrl_sparse.methods.diffusion.METHODS`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse.blocks.mask import BLOCK_TYPES, MaskError, Reuse, check_form, check_reuse, validate_mask
from torchrl_sparse.errors import InputError
from torchrl_sparse.keys import COND, PRUNE_MASK, read
from torchrl_sparse.networks.fingerprint import is_same_policy

__all__ = ["Dense", "PlanSpec", "Planner", "StaticPlanner"]


@dataclass(frozen=True)
class PlanSpec:
    """The policy and the sampler that a planner serves.

    Attributes:
        num_inference_steps: denoising steps K of a policy call.
        num_layers: layers L of the network.
        policy: fingerprint of the policy; a plan that was made for one policy is refused by another.
        sampler: name of its sampler, see `Sampler.name`.
        block_types: blocks of a layer.
    """

    num_inference_steps: int
    num_layers: int
    policy: str
    sampler: str = "ddpm"
    block_types: tuple[str, ...] = BLOCK_TYPES

    @property
    def num_blocks(self) -> int:
        """Blocks of all layers, 3L or 2L, the width of a mask."""
        return len(self.block_types) * self.num_layers

    def check_is(self, asked: PlanSpec, who: str) -> None:
        """Raise InputError, naming ``who``, unless ``asked`` is the policy and sampler it was built for.

        Where another sampler is asked for, the message says in which order plan and sampler are assigned.

        >>> PlanSpec(100, 8, "a policy").check_is(PlanSpec(100, 8, "another"), "BAC")
        Traceback (most recent call last):
        ...
        torchrl_sparse.errors.InputError: BAC: made for policy fingerprint 'a policy', got 'another'
        """
        for name in (field.name for field in fields(self)):
            made_for, got = getattr(self, name), getattr(asked, name)
            if made_for != got and not (name == "policy" and is_same_policy(made_for, got)):
                label, remedy = name, ""
                if name == "policy":
                    label = "policy fingerprint"
                elif name != "num_layers":
                    remedy = "; assign plan = None, then the sampler, then a plan that was made for it"
                raise InputError(f"{who}: made for {label} {made_for!r}, got {got!r}{remedy}")


class Planner(TensorDictModuleBase):
    """Base of all modules that decide which blocks a policy call skips.

    Reads ``("diffusion", "cond")`` f32 [*B, To, D], writes ``("diffusion", "prune_mask")`` bool [*B, K, 3L].
    A subclass writes :meth:`masks`; one that reads more keys also overrides :meth:`options`, and one that was made for
    one policy sets ``made_for``. ``policy.plan = planner`` binds it.

    Attributes:
        reuse: what a pruned block reuses, ``"block"``, ``"type"`` or ``"single"`` (see
            :mod:`torchrl_sparse.blocks.mask`), of all observations.
        is_static: True where the mask does not depend on the observation.
        made_for: the only spec that it can be bound to; None serves every policy.
        rate: prune rate of the calls that bring none; None where no rate is asked for. Assign another to change it.
        flops: of deciding one mask, 2 * MAC; part of what the call costs.

    Examples:
        >>> from tensordict import TensorDict
        >>> class OnlyWhenFar(Planner):
        ...     "Skips every second step of the observations that are far from zero."
        ...     def masks(self, cond):
        ...         odd = torch.arange(self.spec.num_inference_steps) % 2 == 1
        ...         far = cond.abs().amax(dim=(1, 2)) > 1
        ...         return (far[:, None] & odd)[..., None].expand(-1, -1, self.spec.num_blocks)
        >>> planner = OnlyWhenFar()
        >>> planner.bind(PlanSpec(num_inference_steps=4, num_layers=1, policy="a policy"))
        >>> td = planner(TensorDict({COND: torch.tensor([[[0.0]], [[2.0]]])}, [2]))
        >>> td[PRUNE_MASK][..., 0].int().tolist()
        [[0, 0, 0, 0], [0, 1, 0, 1]]
    """

    in_keys = [COND]
    out_keys = [PRUNE_MASK]
    reuse: Reuse = "block"
    is_static = False
    made_for: PlanSpec | None = None
    rate: float | None = None
    flops: int = 0

    def __init__(self) -> None:
        super().__init__()
        self._spec: PlanSpec | None = None

    @property
    def spec(self) -> PlanSpec:
        """The spec that the planner is bound to.

        Raises:
            RuntimeError: before :meth:`bind`.
        """
        if self._spec is None:
            raise RuntimeError(
                f"{type(self).__name__} is not bound: assign it to `policy.plan`, or call bind(PlanSpec(...))"
            )
        return self._spec

    def bind(self, spec: PlanSpec) -> None:
        """Prepare the planner for ``spec``; a policy calls it on assignment of the planner or of another sampler.

        Raises:
            InputError: if the planner was made for another, or its ``reuse`` is no rule; it then stays as it was.
        """
        check_reuse(self.reuse)
        if self.made_for is not None:
            self.made_for.check_is(spec, type(self).__name__)
        self._prepare(spec)
        self._spec = spec

    def _prepare(self, spec: PlanSpec) -> None:
        """Make what :meth:`masks` needs for ``spec``, or raise InputError and leave everything as it is."""

    @property
    def fingerprint(self) -> str:
        """A hash of what determines the masks: planners of one class with one fingerprint write equal masks."""
        return tensors_fingerprint(self.state_dict())

    def masks(self, cond: Tensor) -> Tensor:
        """Return masks bool [B, K, 3L], row 0 all False, for encoded observations ``cond`` f32 [B, To, D]."""
        raise NotImplementedError(f"{type(self).__name__} must define masks(cond)")

    def options(self, tensordict: TensorDictBase, rows: int) -> dict[str, Tensor]:
        """Return further arguments of :meth:`masks`, each with the batch dimensions flattened to ``rows``."""
        return {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the mask of every observation; the engine validates it.

        Raises:
            RuntimeError: if the planner is not bound.
            InputError: if :meth:`masks` returns anything but bool tensors [B, K, 3L] for the bound spec.
        """
        spec = self.spec
        cond = read(tensordict, COND)
        batch = cond.shape[:-2]
        rows = batch.numel()
        flat = len(batch) == 1  # as nearly always: nothing to reshape, which also takes time
        if not flat:
            cond = cond.reshape(rows, *cond.shape[-2:])
        masks = self.masks(cond, **self.options(tensordict, rows))
        try:
            check_form(masks, spec.num_inference_steps, spec.num_layers, (rows,), spec.block_types)
        except MaskError as error:
            raise InputError(f"{type(self).__name__}.masks: {error}") from error
        return tensordict.set(PRUNE_MASK, masks if flat else masks.reshape(*batch, *masks.shape[1:]))


def tensors_fingerprint(tensors: Mapping[str, Tensor]) -> str:
    """Return sixteen hexadecimal digits that identify the values of named tensors."""
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().flatten().view(torch.uint8).numpy())  # as bytes: numpy has no bf16
    return digest.hexdigest()[:16]


class StaticPlanner(Planner):
    """Base of planners whose mask does not depend on the observation; subclasses define :meth:`mask`."""

    is_static = True

    def __init__(self) -> None:
        super().__init__()
        # Not persistent: the mask belongs to the method, not to the policy's checkpoint.
        self.register_buffer("_mask", None, persistent=False)

    def mask(self, spec: PlanSpec) -> Tensor:
        """Return the mask bool [K, 3L] of all policy calls for ``spec``, row 0 all False.

        Raises:
            InputError: if the planner cannot serve ``spec``.
        """
        raise NotImplementedError(f"{type(self).__name__} must define mask(spec)")

    def _prepare(self, spec: PlanSpec) -> None:
        mask = self.mask(spec)
        try:
            validate_mask(mask, spec.num_inference_steps, spec.num_layers, (), spec.block_types)
        except ValueError as error:
            raise InputError(f"{type(self).__name__}.mask: {error}") from error
        self._mask = mask

    @property
    def static_mask(self) -> Tensor | None:
        """The mask bool [K, 3L] that every policy call gets; None before :meth:`bind`."""
        return self._mask

    @property
    def fingerprint(self) -> str:
        """A hash of the bound mask."""
        return tensors_fingerprint({"mask": self.mask(self.spec)})

    def masks(self, cond: Tensor) -> Tensor:
        """Return the mask, repeated for each row of ``cond``."""
        # A copy per row: an expanded view in the TensorDict would break whoever writes to one row in place.
        return self._mask.to(cond.device).repeat(len(cond), 1, 1)


class Dense(StaticPlanner):
    """Planner that prunes nothing: the unmodified policy, through the same code path as every method.

    Examples:
        >>> Dense().mask(PlanSpec(num_inference_steps=100, num_layers=8, policy="any")).any().item()
        False
    """

    def mask(self, spec: PlanSpec) -> Tensor:
        """Return an all-False mask, [K, 3L]."""
        return torch.zeros(spec.num_inference_steps, spec.num_blocks, dtype=torch.bool)
