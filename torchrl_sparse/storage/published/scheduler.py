"""Sampler of a published checkpoint, from its diffusers scheduler and policy entries.

All entries of diffusers' ``DDPMScheduler`` and ``DDIMScheduler`` are known: honoured, supported at one value, or without
effect at the supported ones (``beta_start`` and ``beta_end`` belong to other schedules of betas, ``sample_max_value`` and
``dynamic_thresholding_ratio`` to thresholding).
"""

from __future__ import annotations

from collections.abc import Collection

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.spacing import falls_evenly
from torchrl_sparse.storage.published.config import PublishedConfig
from torchrl_sparse.storage.published.entries import Section

__all__ = ["read_sampler"]

_PLACE = "policy.noise_scheduler"
_KINDS = {"DDPMScheduler": "ddpm", "DDIMScheduler": "ddim"}
_SPACINGS = ("leading", "linspace", "trailing")
_COMMON = {  # with diffusers' defaults
    "beta_schedule": ("linear", "squaredcos_cap_v2"),
    "trained_betas": (None, None),
    "clip_sample": (True, True),
    "prediction_type": ("epsilon", "epsilon"),
    "thresholding": (False, False),
    "rescale_betas_zero_snr": (False, False),
    "variance_type": ("fixed_small", "fixed_small"),  # of DDPM; DDIM's variance is that times eta squared
}
_READ = frozenset({"num_train_timesteps", "clip_sample_range", "timestep_spacing", "steps_offset"})
_UNUSED = frozenset({"beta_start", "beta_end", "sample_max_value", "dynamic_thresholding_ratio"})
_NULLABLE = frozenset({"trained_betas"})
_SECTIONS = {
    "ddpm": Section(_COMMON, _READ, _UNUSED, _NULLABLE),
    "ddim": Section(_COMMON | {"set_alpha_to_one": (True, True)}, _READ, _UNUSED, _NULLABLE),
}


def read_sampler(config: PublishedConfig, ignore: Collection[str] = ()) -> Sampler:
    """Build the sampler of a published checkpoint.

    Args:
        config: the configuration.
        ignore: paths of entries that are passed over where they are not known.

    Raises:
        InputError: naming the entry, if it is not known or `Sampler` does not have what it asks for.
    """
    target = config.get(f"{_PLACE}._target_", str)
    package, _, name = target.rpartition(".")
    if package.partition(".")[0] != "diffusers" or name not in _KINDS:
        raise InputError(f"cfg: {_PLACE}._target_: expected diffusers' {' or '.join(_KINDS)}, got {target}")
    kind = _KINDS[name]
    _SECTIONS[kind].check(config, _PLACE, ignore)
    trained = {
        "num_train_timesteps": config.get(f"{_PLACE}.num_train_timesteps", int, 1000),
        "clip_sample_range": config.get(f"{_PLACE}.clip_sample_range", float, 1.0),
    }
    steps = config.get("policy.num_inference_steps", int, trained["num_train_timesteps"])
    spacing = config.get(f"{_PLACE}.timestep_spacing", str, "leading")
    if spacing not in _SPACINGS:
        raise InputError(f"cfg: {_PLACE}.timestep_spacing: expected one of {_SPACINGS}, got {spacing!r}")
    offset = config.get(f"{_PLACE}.steps_offset", int, 0) if spacing == "leading" else 0
    eta = config.get("policy.eta", float, 0.0)
    if eta and kind == "ddpm":
        raise InputError(f"cfg: policy.eta: expected none of DDPM, whose step does not take it, got {eta}")
    try:
        sampler = Sampler(kind, steps, eta=eta, spacing=spacing, **trained)
        if offset:
            timesteps = [timestep + offset for timestep in sampler.timesteps.tolist()]
            sampler = Sampler(kind, steps, timesteps=timesteps, eta=eta, **trained)
    except ValueError as error:
        place = f"{_PLACE}.steps_offset" if offset else _PLACE
        raise InputError(f"cfg: {place}: {error}") from error
    if kind == "ddim" and not falls_evenly(sampler.timesteps.tolist(), sampler.num_train_timesteps):
        gap = sampler.num_train_timesteps // steps
        raise InputError(
            f"cfg: {_PLACE}.timestep_spacing: expected timesteps {gap} apart that end within {gap} of the clean sample, where "
            f"diffusers' DDIM leads whatever its spacing, got {spacing!r} with steps_offset {offset} in {steps} steps"
        )
    return sampler
