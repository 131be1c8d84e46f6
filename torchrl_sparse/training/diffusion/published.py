"""Published shapes of Diffusion Policy's transformer on states (arXiv:2303.04137, Table VII), by task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["PublishedShape", "published_network", "published_shape", "with_published"]


@dataclass(frozen=True)
class PublishedShape:
    """Published choices that differ between tasks; all networks have 8 layers and 4 heads.

    Attributes:
        horizon: actions of a chunk (Tp).
        n_obs_steps: observations of a policy call (To).
        n_action_steps: actions executed of a chunk (Ta).
        n_emb: width.
        p_drop_attn: dropout in and after every block.
        weight_decay: of training.
    """

    horizon: int = 10
    n_obs_steps: int = 2
    n_action_steps: int = 8
    n_emb: int = 256
    p_drop_attn: float = 0.3
    weight_decay: float = 1e-3


_SHAPES = {
    "pusht": PublishedShape(horizon=16, p_drop_attn=0.01, weight_decay=1e-1),
    "block_push": PublishedShape(horizon=5, n_obs_steps=3, n_action_steps=1),
    "kitchen": PublishedShape(horizon=16, n_obs_steps=4, n_emb=768, p_drop_attn=0.1),
}


def published_shape(task: str) -> PublishedShape:
    """Return the published shape for a task. The robosuite tasks share one, also used for tasks without a published policy.

    Raises:
        InputError: if there is no such task.

    >>> published_shape("kitchen").n_emb, published_shape("lift").n_emb
    (768, 256)
    """
    return _SHAPES.get(find_task(task).alias, PublishedShape())


def executed_steps(task: str, source: Mapping[str, Any], chosen: int | None = None) -> int:
    """Return the executed actions per chunk: ``chosen``, else from ``source``, else the published number.

    Args:
        task: a name or alias.
        source: of a policy.
        chosen: by the user.

    Raises:
        InputError: if there is no such task.

    >>> executed_steps("block_push", {}), executed_steps("lift", {"n_action_steps": 4})
    (1, 4)
    """
    return chosen or source.get("n_action_steps") or published_shape(task).n_action_steps


def with_published(task: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``options`` with None replaced by the task's published choice, where `PublishedShape` has one.

    Raises:
        InputError: if there is no such task.

    >>> with_published("kitchen", {"n_emb": None, "horizon": 8, "seed": None})
    {'n_emb': 768, 'horizon': 8, 'seed': None}
    """
    shape = asdict(published_shape(task))
    return {name: shape.get(name) if value is None else value for name, value in options.items()}


def published_network(task: str, **changes: Any) -> TransformerForDiffusion:
    """Return an untrained network of the published shape for a task.

    Args:
        task: a name or alias.
        changes: arguments of `TransformerForDiffusion` that shall differ.

    Raises:
        InputError: if there is no such task.

    >>> network = published_network("pusht")
    >>> network.horizon, network.cond_dim, sum(p.numel() for p in network.parameters())
    (16, 20, 8965122)
    """
    found, sizes = find_task(task), asdict(published_shape(task))
    del sizes["n_action_steps"], sizes["weight_decay"]
    dims = {"input_dim": found.action_dim, "output_dim": found.action_dim, "cond_dim": found.state_dim}
    return TransformerForDiffusion(**(dims | sizes | changes))
