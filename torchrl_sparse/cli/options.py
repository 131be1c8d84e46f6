"""The table of values that recipe options accept; an option name means the same in every recipe.

A recipe's yaml has the defaults and says what each option does. Whether there is a task of a name is checked where it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from omegaconf import OmegaConf
from pydantic import AfterValidator, Field

from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.devices import check_device
from torchrl_sparse.storage.json import check_plain

_PACKAGE = Path(__file__).parents[1]

__all__ = ["OPEN_SECTIONS", "OPTIONS", "check_names", "check_options"]


def _path_or_paths(value: Any) -> Any:
    paths = [value] if isinstance(value, str) else value
    if not (isinstance(paths, list) and paths and all(isinstance(path, str) for path in paths)):
        raise InputError(f"expected a path or a list of them, got {value!r}")
    return value


Count = Annotated[int, Field(ge=1)]
Whole = Annotated[int, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(gt=0, le=1)]
BelowOne = Annotated[float, Field(ge=0, lt=1)]
Between = Annotated[float, Field(gt=0, lt=1)]
Word = Annotated[str, Field(min_length=1)]
Words = Annotated[list[Word], Field(min_length=1)]
Pair = Annotated[list[Word], Field(min_length=2, max_length=2)]
Paths = Annotated[Any, AfterValidator(_path_or_paths)]
Section = dict[str, Any]

OPTIONS: dict[str, Any] = {
    # what is done, on what, where to
    "task": Word,
    "policy": Word,
    "collect_demos.policy": Word | None,
    "heads": Annotated[list[Count], Field(min_length=3, max_length=3)] | None,
    "published": Section,
    "poses": bool,
    "format": Literal["robomimic", "pusht"] | None,
    "planners": Word,
    "demos": Word | None,
    **dict.fromkeys(("train_policy.demos", "train_vla.demos"), Paths),
    **dict.fromkeys(("out", "runs"), Word),
    "dense_log": Word | None,
    **dict.fromkeys(("files", "aggregate", "budgets"), list[Word]),
    "title": str,
    "errors": Literal["refuse", "failure", "exclude"],
    **dict.fromkeys(("reference", "html", "table_file", "lerobot", "picture", "serve.method"), Word | None),
    **dict.fromkeys(("sweep", "host"), Word),
    "project": Word,
    "mode": Literal["offline", "online", "disabled"] | None,
    "sweep.mode": Literal["offline", "online"],
    **dict.fromkeys(("entity", "group", "name"), Word | None),
    "tags": list[Word],
    "count": Count | None,
    "wandb": Section,
    # methods
    "method": Word,
    "methods": Words,
    "benchmark.methods": Words | None,
    "benchmark_vla.methods": list[Word],  # none: dense alone
    "calibrate_bac.methods": Annotated[
        list[Literal["bac", "bac_blockwise", "bac_unified"]], Field(min_length=1)
    ],
    "pairs": list[Pair],
    "videos": list[Word],
    "rank": Count | None,
    "num_updates": Count,
    "calibration_samples": Count,
    "samples": Count,
    "objective": Word,
    "calibrate_bac.objective": Literal["anchor", "consecutive"],
    "top_k": Count,
    "strides": Annotated[list[Count], Field(min_length=1)],
    "num_inference_steps": Count,
    "timesteps": Annotated[list[Whole], Field(min_length=1)],
    "kind": Word,
    "eta": Annotated[float, Field(ge=0, le=1)],
    "spacings": Words,
    "samplers": Words,
    "sampler": Section | None,
    **dict.fromkeys(("base", "equal_to", "calibrate_bac.sampler", "profile_policy.sampler"), Word | None),
    **dict.fromkeys(("candidates",), Section),
    **dict.fromkeys(("accelerate_policy.candidates.samplers", "searched", "cached", "rounded"), list[Word]),
    **dict.fromkeys(("updates", "intervals"), list[Count]),
    "specprune": Section,
    "options": Section,
    **dict.fromkeys(("alphas", "numbers"), Annotated[list[Positive], Field(min_length=1)]),
    "shares": list[Share],
    "measure": Word,
    "tolerance": NotNegative,
    "controller": Section | None,
    # episodes
    "episodes": Count,
    "split": Literal["development", "test"],
    "table": Literal["short", "full"],
    "accelerate_policy.episodes": Whole,
    **dict.fromkeys(("finalists", "windows"), Count),
    "until": Literal["episodes", "conclusive"],
    **dict.fromkeys(("max_episodes", "eval_episodes", "probe_episodes", "analyses"), Count),
    "seed": Whole,
    "evaluate_policy.seed": Whole | None,
    **dict.fromkeys(("horizon", "n_action_steps"), Count | None),
    "steps": Count,
    "latencies": list[NotNegative],  # none: each method at its own
    **dict.fromkeys(("num_envs", "workers"), Count),
    "backend": Literal["process", "ray"],
    **dict.fromkeys(("skipped_layers", "warmup"), Whole),
    "quality": Word,
    "keep_failures": bool,
    "mixing": Annotated[float, Field(ge=0, le=1)],
    # what is measured, and how
    **dict.fromkeys(("margin", "time_margin", "power"), Between),
    "success": Annotated[list[Between], Field(min_length=1)],
    "correlations": Annotated[list[BelowOne], Field(min_length=1)],
    "difference": Annotated[float, Field(gt=-1, lt=1)],
    "budget_ms": Positive | None,
    **dict.fromkeys(("latency_repeats", "repeats", "queries"), Count),
    **dict.fromkeys(("compile", "instruction_sets", "calibrated", "world"), bool),
    "tables": Annotated[list[Literal["call", "engines"]], Field(min_length=1)],
    "batches": Annotated[list[Count], Field(min_length=1)],
    **dict.fromkeys(("shape", "instruction", "profile_policy.task", "serve.task"), Word | None),
    "threads": Count | None,
    "thread_counts": Annotated[list[Annotated[int, Field(ge=1, le=64)]], Field(min_length=1)],
    "hz": Positive | None,
    "busy": Whole,
    "library": Word | None,
    "engine": Word,
    "profile_policy.engine": Literal["auto", "native", "native_bf16", "native_int8", "openvino", "torch"],
    "device": Annotated[Word, AfterValidator(check_device)],
    "dtype": Literal["float32", "float16", "bfloat16"] | None,
    # a server
    "answers": Literal["action", "chunk"],
    "port": Annotated[int, Field(ge=0, le=65535)],
    **dict.fromkeys(("max_clients", "max_message_bytes", "report_every"), Count),
    # cameras
    "cameras": Section,
    "convert_demos.cameras": list[Word],  # none: nothing is rendered
    "image": Word | None,
    "wrist_image": Word | None,
    "image_size": Count,
    # training
    "train": Section,
    "accelerate_policy.train": bool,
    "pruner": Section,
    "filter_key": Word | None,
    "init": Word | None,
    "train_pruner.init": Annotated[Any, AfterValidator(_path_or_paths)] | None,
    "state_normalization": Literal["global", "range"] | None,
    "targets": Section,
    "share": Share,
    "source": Word,
    "rollouts": Whole,
    "grounding": Section,
    "locate_steps": Whole,
    "refer_steps": Whole,
    "max_steps": Count,
    "max_updates": Whole | None,
    **dict.fromkeys(("epochs", "batch_size"), Count),
    **dict.fromkeys(("lr", "ema_power"), Positive),
    "lr_warmup_steps": Whole,
    "weight_decay": NotNegative | None,
    "max_grad_norm": NotNegative,
    "ema_max_decay": BelowOne,
    "precision": Literal["fp32", "bf16"],
    "val_ratio": BelowOne,
    "rate": Between,
    "rate_range": Annotated[list[Between], Field(min_length=2, max_length=2)] | None,
    "beta": NotNegative,
    "norm": Word,
    "estimator": Word,
    "temperature": Positive,
    "final_temperature": Positive | None,
    "variety": NotNegative,
    "information": Share | None,
    "spread": Positive | None,
    "sparsity": Word,
    "cost": Word,
    "reuse": Word,
    "gradient": Word,
    "detached": bool,
    "explore": Share,
    "checkpointed": bool,
    "log_every": Count,
    "checkpoint_every": Count,
    "eval_every": Whole,
    "eval_ddim_steps": Count | None,
    "logger": Literal["csv", "wandb"] | None,
    # sizes of networks
    "size": Word | None,
    "network": Section,
    "vision": Section,
    "crop": Share | None,
    "width": Count,
    **dict.fromkeys(("train_policy.vision.width", "n_layer", "n_head"), Count | None),
    "obs_width": Count,
    "hidden": Count,
    "reads": Literal["all", "state"],
    **dict.fromkeys(("n_emb", "n_obs_steps"), Count | None),
    "n_cond_layers": Whole | None,
    **dict.fromkeys(("p_drop_emb", "p_drop_attn"), BelowOne | None),
    "causal_attn": bool | None,
    "chunk_size": Count,
}
"""Option, of one recipe alone after its name and a dot -> type. Of nested options the last word counts."""

OPEN_SECTIONS = ("specprune", "options", "controller", "published", "train_vla.network")
"""Sections whose entries are those of a dataclass of the library, which checks them."""


# ${folder:PATH} in a yaml: where what is made of PATH lies, the folder itself or, beside a file.ckpt, that named `file`
OmegaConf.register_new_resolver("folder", lambda path: path and path.removesuffix(".ckpt"), replace=True)
# ${shipped:assets/lift}: that folder, or where there is none here the one that a wheel brought, or the repository's
_ROOTS = (Path(), _PACKAGE, _PACKAGE.parent)
OmegaConf.register_new_resolver(
    "shipped",
    lambda path: next((str(root / path) for root in _ROOTS if (root / path).exists()), path),
    replace=True,
)


def check_options(recipe: str, options: Mapping[str, Any], table: Mapping[str, Any] = OPTIONS) -> None:
    """Raise InputError, ``key: expected …, got …``, for the first option that violates `OPTIONS`.

    Args:
        recipe: name of the recipe.
        options: its options, nested as in its yaml.
        table: option -> type, as `OPTIONS`.

    >>> check_options("benchmark", {"task": "lift", "episodes": 0})
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: episodes: expected greater than or equal to 1, got 0
    """
    for key, value in _leaves(recipe, options):
        kind = _lookup(recipe, key, table)
        if kind is None:
            raise InputError(f"{key}: expected no such option, got {value!r}")
        check_plain(value, kind, key)


def _leaves(recipe: str, options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in options.items():
        key = prefix + name
        yield key, value
        if isinstance(value, dict) and not {name, f"{recipe}.{name}"} & set(OPEN_SECTIONS):
            yield from _leaves(recipe, value, f"{key}.")


def _lookup(recipe: str, key: str, table: Mapping[str, Any]) -> Any:
    word = key.rpartition(".")[2]
    return table.get(f"{recipe}.{key}", table.get(word))


def check_names(options: Mapping[str, Any], check: Callable[[str], None]) -> None:
    """Raise InputError for unknown names in a benchmark's ``methods`` or ``videos``, or unmeasured ones in its ``pairs``.

    Args:
        options: of the benchmark.
        check: raises InputError, ``methods: …``, for a name that is no method.

    >>> options = {"methods": ["bac"], "videos": [], "pairs": [["dense", "sag"]]}
    >>> check_names(options, lambda name: None)
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: pairs: expected two of dense, bac, got ['dense', 'sag']
    """
    for name in options["methods"]:
        check(name)
    for name in options["videos"]:
        try:
            check(name)
        except ValueError as error:
            raise InputError(f"videos{str(error).removeprefix('methods')}") from error
    methods = list(dict.fromkeys(["dense", *options["methods"]]))
    for pair in options["pairs"]:
        if not set(pair) <= set(methods):
            raise InputError(f"pairs: expected two of {', '.join(methods)}, got {list(pair)}")


def given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are set, that is, not None.

    >>> given({"size": None, "rank": 16})
    {'rank': 16}
    """
    return {name: value for name, value in options.items() if value is not None}
