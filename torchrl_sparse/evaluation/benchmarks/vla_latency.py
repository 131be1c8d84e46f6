"""Times of a vision-language-action model's parts, and the savings of token pruning; see `results.vla_report`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import Latency, Machine, measure_latency
from torchrl_sparse.evaluation.latency.vla_cases import VLACase
from torchrl_sparse.evaluation.latency.vla_products import ProductCall, product_calls
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.vla_report import (
    SCHEMA,
    Helper,
    Part,
    Product,
    VLALatency,
    VLAMethod,
    VLAShape,
)
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.tokens import FastVPruner, FrameDifferencePruner, RandomPruner, SpecPrune
from torchrl_sparse.tokens.base import TokenPruner

__all__ = ["measure_vla", "token_pruners"]


def token_pruners(
    policy: VLAPolicy, alphas: Iterable[float], shares: Iterable[float], equal_to: str | None = None
) -> dict[str, TokenPruner | None]:
    """Return dense, SpecPrune at every alpha, and FastV and random pruning at every share of visual tokens.

    Args:
        policy: that they are for.
        alphas, shares: positive; shares at most 1.
        equal_to: name of one of them, whose mean of tokens in a layer FastV, frame difference and random keep too.

    Raises:
        InputError: if ``equal_to`` is none of them, or keeps fewer tokens than the layers before FastV's do.
    """
    pruners: dict[str, TokenPruner | None] = {DENSE: None}
    pruners |= {f"specprune, alpha {alpha:g}": SpecPrune(alpha=alpha) for alpha in alphas}
    for name, kind in (("fastv", FastVPruner), ("random", RandomPruner)):
        pruners |= {f"{name}, {share:.0%}": kind(share) for share in shares}
    return pruners if equal_to is None else pruners | _equal_pruners(policy, pruners, equal_to)


def _equal_pruners(
    policy: VLAPolicy, pruners: Mapping[str, TokenPruner | None], name: str
) -> dict[str, TokenPruner]:
    if name not in pruners:
        raise InputError(f"equal_to: expected one of {', '.join(pruners)}, got {name!r}")
    share = VLACase(policy, {name: pruners[name]}).answer(name)[keys.KEPT].item()
    share /= policy.network.config.num_visual
    # the share of layers that see every token
    before = FastVPruner().layer / policy.network.config.llm.layers
    if share <= before:
        raise InputError(
            f"equal_to: expected a method that keeps more than {before:.0%}, got {share:.0%} of {name}"
        )
    return {
        "fastv, as many": FastVPruner((share - before) / (1 - before)),
        "frame difference, as many": FrameDifferencePruner(share),
        "random, as many": RandomPruner(share),
    }


def measure_vla(
    case: VLACase,
    *,
    name: str,
    machine: Machine,
    repeats: int,
    warmup: int = 2,
) -> VLALatency:
    """Time the parts of the dense policy call and all methods, all interleaved.

    Args:
        case: with a method ``"dense"``.
        name: of its shape.
        machine: that this runs on.
        repeats, warmup: rounds, see `measure_latency`.
    """
    pruned = [name for name, policy in case.policies.items() if policy.pruner is not None]
    calls = {("parts", part): call for part, call in case.parts().items()}
    calls |= {("query", method): lambda method=method: case.answer(method) for method in case.policies}
    calls |= {(method, helper): call for method in pruned for helper, call in case.helpers(method).items()}
    weight = next(case.network.parameters())
    products = product_calls(case)
    calls |= {("products", name): product.call for name, product in products.items()}
    with progress(name, "round", repeats) as show:
        latency = measure_latency(calls, repeats, warmup, device=weight.device, on_round=show)
    shape = VLAShape(
        name=name,
        dtype=str(weight.dtype).removeprefix("torch."),
        parameters=sum(parameter.numel() for parameter in case.network.parameters()),
        tokens=case.sequence().hidden.shape[1],
        visual_tokens=case.network.config.num_visual,
        config=case.network.config.to_dict(),
    )
    methods = {method: _method(method, case, latency) for method in case.policies}
    timed = {part: _product(latency["products", part].p50, product) for part, product in products.items()}
    return VLALatency(SCHEMA, machine, shape, _parts(latency), methods, timed)


def _product(seconds: float, product: ProductCall) -> Product:
    return Product(seconds, product.flops, product.flops / seconds)


def _parts(latency: Mapping[tuple[str, str], Latency]) -> dict[str, Part]:
    whole = latency["query", DENSE].p50
    timed = {name: times for (kind, name), times in latency.items() if kind == "parts"}
    rest = max(0.0, whole - sum(times.p50 for times in timed.values()))
    parts = {name: Part(share=times.p50 / whole, **_percentiles(times)) for name, times in timed.items()}
    return parts | {"rest": Part(rest, rest / whole)}


def _method(name: str, case: VLACase, latency: Mapping[tuple[str, str], Latency]) -> VLAMethod:
    answer, dense = case.answer(name), case.answer(DENSE)
    own, flops = latency["query", name], answer[keys.FLOPS].item()
    expected, speedup = dense[keys.FLOPS].item() / flops, latency["query", DENSE].p50 / own.p50
    depth = answer[keys.TOKEN_DEPTH]
    helpers = _helpers({part: t.p50 for (method, part), t in latency.items() if method == name}, own.p50)
    return VLAMethod(
        **_percentiles(own),
        flops=flops,
        kept=answer[keys.KEPT].item(),
        tokens_per_layer=tuple(int((depth > layer).sum()) for layer in range(case.network.config.llm.layers)),
        flops_speedup=expected,
        speedup=speedup,
        realised=speedup / expected,
        helpers=helpers,
        helper_share=sum(helper.share for helper in helpers.values()),
    )


def _helpers(seconds: dict[str, float], query: float) -> dict[str, Helper]:
    if "comparing" in seconds:
        seconds["choosing"] = max(0.0, seconds["choosing"] - seconds["comparing"])
    return {name: Helper(value, value / query) for name, value in seconds.items()}


def _percentiles(latency: Latency) -> dict[str, Any]:
    p10, p90 = np.percentile(latency.samples, [10, 90])
    return {"p50_s": latency.p50, "p10_s": float(p10), "p90_s": float(p90), "n": latency.n}
