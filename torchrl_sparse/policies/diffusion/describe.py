"""Description of a policy's inputs and outputs as text."""

from __future__ import annotations

from typing import Any

from torchrl_sparse.storage.convention import source_convention


def describe(policy: Any) -> str:
    """Return lines of text on observation layout and ranges, on the chunk, and on the training.

    A range is what the normaliser maps to [-1, 1], that of the demonstrations. Robosuite 1.5 orders the parts of the objects'
    state otherwise than 1.4 did, and turned the sign of some, see `torchrl_sparse.envs.conventions`. This library's
    environments and demonstrations follow the policy. A state from elsewhere has to be as this says.

    Args:
        policy: a `DiffusionPolicy`, whose method this is.

    >>> from torchrl_sparse import DiffusionPolicy
    >>> print(DiffusionPolicy.from_pretrained("assets/lift").describe().splitlines()[1])
      state, 19 numbers: the layout of its task
    """
    source, low_high = policy.source, _ranges(policy)
    names = source.get("state_keys")
    lines = [
        f"observes the last {policy.n_obs_steps} of",
        f"  state, {len(low_high)} numbers: {', '.join(names) if names else 'the layout of its task'}",
        *(f"    [{i}] {low:.3g} to {high:.3g}" for i, (low, high) in enumerate(low_high)),
    ]
    if "object" in names if names else policy.vision is None:
        lines.append(
            f"  objects, if its task has them, as robosuite {source_convention(source)} observes them"
        )
    if policy.vision is not None:
        height, width = policy.vision.image_size
        lines += [f"  {camera}, uint8 [{height}, {width}, 3]" for camera in policy.vision.cameras]
    chunk, size = policy.horizon - policy.n_obs_steps + 1, policy.network.output_dim
    lines.append(f"returns {chunk} actions of {size} numbers, the first for the present step")
    lines.append(
        f"in {policy.num_inference_steps} calls of {policy.sampler.name}, {type(policy.plan).__name__}"
    )
    lines += [
        f"{name}: {value}" for name, value in source.items() if name != "state_keys" and value is not None
    ]
    return "\n".join(lines)


def _ranges(policy: Any) -> list[tuple[float, float]]:
    low, high = policy.normalizer.state_range()
    return list(zip(low.tolist(), high.tolist(), strict=True))
