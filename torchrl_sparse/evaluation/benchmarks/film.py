"""Films of an episode: camera views, the method's pruning, and the time of each policy call."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.evaluation.figures.masks import mask_panel
from torchrl_sparse.evaluation.figures.tokens import draw_tokens, plot_control, plot_token_strip
from torchrl_sparse.evaluation.figures.video import Caption, write_video
from torchrl_sparse.evaluation.rollouts.vla_methods import seen_images
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["captions", "film_masks", "film_tokens"]

_CAMERA, _SIZE = "agentview", 320
_SHOWN = 6  # policy calls of a strip
_ZOOM = 2


def film_masks(
    name: str, actor: ChunkExecutor, make_env: Callable[..., EnvBase], seed: int, out: Path, threads: int
) -> None:
    """Film a diffusion policy's episode, with the latest call's mask beside the image if masks depend on the observation.

    Args:
        name: of the method; the film is ``out/rollout_NAME.mp4``.
        actor: the method's policy and how its chunks are executed.
        make_env: called as ``make_env(seeds=[seed])``.
        seed: of the episode.
        out: folder of the film.
        threads: of PyTorch meanwhile, as captions tell what each call took.

    Raises:
        RuntimeError: without a GL library, before any call.
    """
    frames, types = [], actor.policy.network.block_types

    def photograph(env: EnvBase, step: TensorDictBase) -> None:
        frame = env.base_env.render(_CAMERA, _SIZE, _SIZE)
        if not actor.policy.plan.is_static:
            frame = np.hstack([frame, mask_panel(step[keys.PRUNE_MASK].numpy(), _SIZE, types)])
        frames.append(frame)

    with closing(make_env(seeds=[seed])) as env, num_threads(threads):
        env.base_env.reset()
        env.base_env.render(_CAMERA, _SIZE, _SIZE)  # fails here where there is no GL library
        steps = env.rollout(env.base_env.horizon, actor, callback=photograph)
        photograph(env, steps[-1])  # a rollout does not call back after its last step
    write_video(frames, out / f"rollout_{name}.mp4", captions=captions(name, steps))


def film_tokens(
    name: str, actor: ChunkExecutor, make_env: Callable[..., EnvBase], seed: int, out: Path, threads: int
) -> None:
    """Film the images and kept tokens of a vision-language-action policy's episode; draw a strip of them, and the fine mode.

    Args:
        name: of the method; the files are ``out/rollout_NAME.mp4``, ``strip_NAME.png`` and ``control_NAME.png``.
        actor, make_env, seed, out, threads: as of `film_masks`; `make_env` renders what the policy sees.
    """
    with closing(make_env(seeds=[seed])) as env, num_threads(threads):
        steps = env.rollout(env.base_env.horizon, actor, auto_cast_to_device=True).cpu()
    draw = partial(draw_tokens, num_layers=actor.policy.network.config.llm.layers, scale=_ZOOM)
    pictures = [
        draw(seen_images(actor.policy, step).numpy(), step[keys.TOKEN_DEPTH].numpy())
        for step in steps.unbind(0)
    ]
    write_video(pictures, out / f"rollout_{name}.mp4", captions=captions(name, steps))
    queries = steps[keys.QUERIED].flatten().nonzero().flatten().tolist()
    shown = np.unique(np.linspace(0, len(queries) - 1, _SHOWN).round().astype(int))
    labels = [f"step {queries[index]}" for index in shown]
    plot_token_strip([pictures[queries[index]] for index in shown], labels, out / f"strip_{name}.png")
    if keys.FINE in steps.keys(True):
        plot_control(
            steps[keys.EEF_VEL][:, :3].norm(dim=-1).numpy(),
            steps[keys.FINE].flatten().numpy(),
            steps[keys.QUERIED].flatten().numpy(),
            out / f"control_{name}.png",
            kept=steps[keys.KEPT].flatten().numpy(),
        )


def captions(name: str, steps: TensorDictBase) -> list[Caption]:
    """Return the caption of each step of an episode [T].

    Args:
        name: of the method.
        steps: [T], of which the first asks the policy.
    """
    made, latency = [], None
    for index, step in enumerate(steps.unbind(0)):
        queried = bool(step[keys.QUERIED])
        latency = float(step[keys.LATENCY]) if queried else latency
        made.append(Caption(name, index, queried, latency, bool(step["next", keys.SUCCESS])))
    return made
