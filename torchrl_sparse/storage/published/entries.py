"""Entries of a published configuration: those that are read, those with one supported value, and those irrelevant to inference.

What a policy computes, observes and does depends on every entry of its ``policy`` and ``task`` sections. So an entry is
read (and compared with the tensors where those tell), fixed to the value that is supported, or listed as one that a call
does not depend on. Any other is refused: what it does is not known here. Entries elsewhere act through references alone.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.published.config import PublishedConfig

__all__ = ["Section", "check_policy_entries", "check_sizes", "check_task_entries"]

_HYDRA = frozenset({"_target_", "_convert_"})


@dataclass(frozen=True)
class Section:
    """Entries allowed in one section.

    Attributes:
        fixed: name -> (what the published code takes where it is missing, what is supported).
        read: names that are read elsewhere.
        unused: names on which a policy call does not depend.
        nullable: those of ``fixed`` and ``read`` that may be null, which is no default to the published code.
    """

    fixed: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    read: frozenset[str] = frozenset()
    unused: frozenset[str] = frozenset()
    nullable: frozenset[str] = frozenset()

    def check(self, config: PublishedConfig, path: str, ignore: Collection[str] = ()) -> None:
        """Raise InputError for an unsupported entry of the section at ``path``, or an unknown one not in ``ignore``."""
        read = self.fixed.keys() | self.read
        for name in config.names(path) or ():
            place = f"{path}.{name}"
            if name not in read | self.unused | _HYDRA and place not in ignore:
                raise InputError(
                    f"cfg: {place}: expected no entry of this name, whose effect is not known here; "
                    f"import with ignore=[{place!r}] if the policy does not depend on it"
                )
            if name in read - self.nullable and config.value(place) is None:
                raise InputError(f"cfg: {place}: expected a value, got null")
        for name, (default, supported) in self.fixed.items():
            check_value(config, f"{path}.{name}", default, supported)


def check_value(config: PublishedConfig, path: str, default: Any, supported: Any) -> None:
    """Raise InputError unless the entry at ``path``, or ``default`` if it is missing, equals ``supported``."""
    found = config.value(path) if supported is None else config.get(path, type(supported), default)
    if found != supported:
        raise InputError(f"cfg: {path}: expected {_written(supported)}, got {_written(found)}")


def _written(value: Any) -> str:
    """Return a value as YAML has it, shortened."""
    return json.dumps(value) if isinstance(value, bool | None) else reprlib.repr(value)


# With latency, the policy is asked about the past and the first actions of its chunk are dropped.
_NO_LATENCY = {"n_latency_steps": (0, 0)}
_TOP = _NO_LATENCY | {
    "past_action_visible": (False, False),
    "keypoint_visible_rate": (1.0, 1.0),  # else some keypoints are zeros
}

_DENOISER = frozenset(
    {"horizon", "n_obs_steps", "n_layer", "n_cond_layers", "n_head", "n_emb", "p_drop_emb", "p_drop_attn"}
    | {"causal_attn"}
)
_POLICY = frozenset({"noise_scheduler", "horizon", "n_action_steps", "n_obs_steps", "num_inference_steps"})
_NULLABLE = frozenset({"num_inference_steps"})  # as many as in training
# What the policy hands on to the scheduler's step; eta is read with the scheduler.
_STEP = {"use_clipped_model_output": (False, False)}
_WHOLE_CHUNK = {"pred_action_steps_only": (False, False)}

_MODEL = Section(
    # Of obs_as_cond, the published denoiser asks cond_dim alone, which the tensors have.
    fixed={"time_as_cond": (True, True), "obs_as_cond": (True, True)},
    read=_DENOISER | {"input_dim", "output_dim", "cond_dim"},
    nullable=frozenset({"n_obs_steps"}),  # as many as the horizon
)
_LOW_DIM = Section(
    fixed={"obs_as_cond": (False, True)} | _WHOLE_CHUNK | _STEP,
    read=_POLICY | {"model", "obs_dim", "action_dim", "eta"},
    nullable=_NULLABLE,
)
_IMAGES = Section(
    fixed={"obs_encoder_group_norm": (False, True), "time_as_cond": (True, True), "obs_as_cond": (True, True)}
    | _WHOLE_CHUNK
    | _STEP,
    read=_POLICY | _DENOISER | {"shape_meta", "crop_shape", "eval_fixed_crop", "eta"},
    nullable=_NULLABLE | {"crop_shape"},
)

_SEEN_TARGET = {"obs_eef_target": (True, True)}  # of block pushing; else two numbers of the state are zeros
_TASK = Section(
    fixed=_SEEN_TARGET,
    read=frozenset({"name", "abs_action", "obs_keys", "obs_dim", "action_dim", "shape_meta", "env_meta"})
    | {"env_runner", "dataset"},
    nullable=frozenset({"name", "env_runner", "dataset", "env_meta", "obs_keys"}),
    # Where data are, and noise of published training and evaluation.
    unused=frozenset({"task_name", "dataset_type", "dataset_path", "dataset_dir", "image_shape"})
    | {"keypoint_dim", "robot_noise_ratio"},
)
_RUNNER = Section(
    fixed=_NO_LATENCY
    | _SEEN_TARGET
    | {"past_action": (False, False), "keypoint_visible_rate": (1.0, 1.0), "agent_keypoints": (False, False)},
    read=frozenset({"abs_action", "obs_keys", "shape_meta", "env_meta", "n_obs_steps", "n_action_steps"}),
    nullable=frozenset({"env_meta"}),
    # Which episodes are played, how long, how many at once, and how they are filmed.
    unused=frozenset(
        {"n_train", "n_train_vis", "train_start_idx", "train_start_seed", "n_test", "n_test_vis"}
    )
    | {
        "test_start_seed",
        "legacy_test",
        "max_steps",
        "n_envs",
        "tqdm_interval_sec",
        "fps",
        "crf",
        "render_hw",
    }
    | {
        "render_obs_key",
        "render_camera_name",
        "render_size",
        "dataset_path",
        "dataset_dir",
        "robot_noise_ratio",
    }
    | {"output_dir"},
)
_DATASET = Section(
    fixed=_NO_LATENCY
    | _SEEN_TARGET
    | {"rotation_rep": ("rotation_6d", "rotation_6d"), "delta_action": (False, False)},
    read=frozenset({"abs_action", "obs_keys", "shape_meta"}),
    # Where demonstrations are, which of them, and how they are cut; the normaliser that they gave is in the file.
    unused=frozenset(
        {"dataset_path", "dataset_dir", "zarr_path", "horizon", "pad_before", "pad_after", "seed"}
    )
    | {"n_obs_steps", "val_ratio", "max_train_episodes", "use_cache", "use_legacy_normalizer"}
    | {"use_manual_normalizer", "robot_noise_ratio"},
)
_SIZES = {
    **{name: name for name in ("horizon", "n_obs_steps", "n_layer", "n_cond_layers", "n_emb", "cond_dim")},
    **dict.fromkeys(("input_dim", "output_dim", "action_dim"), "input_dim"),
    "obs_dim": "cond_dim",
}


def check_policy_entries(config: PublishedConfig, *, cameras: bool, ignore: Collection[str]) -> None:
    """Raise InputError for an unknown or unsupported entry of ``policy``.

    Args:
        config: the configuration.
        cameras: whether it is an image policy, whose denoiser has no section of its own.
        ignore: paths of entries that are passed over where they are not known.
    """
    for name, values in _TOP.items():
        check_value(config, name, *values)
    if cameras:
        _IMAGES.check(config, "policy", ignore)
    else:
        _LOW_DIM.check(config, "policy", ignore)
        _MODEL.check(config, "policy.model", ignore)


def check_task_entries(
    config: PublishedConfig, ignore: Collection[str]
) -> tuple[list[str] | None, bool | None]:
    """Check the entries of ``task``; return observation names and whether actions are absolute, None where unspecified.

    Raises:
        InputError: for an entry that is not known or not supported, or two that contradict each other.
    """
    for path, section in (("task", _TASK), ("task.env_runner", _RUNNER), ("task.dataset", _DATASET)):
        section.check(config, path, ignore)
    places = ("task", "task.env_runner", "task.dataset")
    keys = _agreed({f"{place}.obs_keys": config.names(f"{place}.obs_keys") for place in places})
    return keys, _agreed(
        {f"{place}.abs_action": config.get(f"{place}.abs_action", bool, None) for place in places}
    )


def _agreed(said: Mapping[str, Any]) -> Any:
    """Return what all places that say something say."""
    said = {place: value for place, value in said.items() if value is not None}
    if not said:
        return None
    first = next(iter(said))
    for place, value in said.items():
        if value != said[first]:
            raise InputError(
                f"cfg: {place}: expected {_written(said[first])}, as {first}, got {_written(value)}"
            )
    return said[first]


def check_sizes(config: PublishedConfig, section: str, sizes: Any, *, cameras: bool) -> None:
    """Compare the configuration's sizes with those of the tensors.

    Args:
        config: the configuration; expressions in it say nothing.
        section: where the denoiser's options are.
        sizes: the denoiser, whose attributes are its sizes.
        cameras: whether the condition is more than the state that ``task`` describes.

    Raises:
        InputError: naming the entry that says otherwise.
    """
    for place in dict.fromkeys(("", "policy.", f"{section}.", "task.", "task.env_runner.")):
        for name, attribute in _SIZES.items():
            if cameras and attribute == "cond_dim":
                continue
            said, found = config.literal(place + name, int), getattr(sizes, attribute)
            if said is not None and said != found:
                raise InputError(f"cfg: {place}{name} is {said}, the tensors say {found}")
