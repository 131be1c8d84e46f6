"""Step one task of each LIBERO suite with a vision-language-action policy pruned by hand speed, and draw the tokens it kept.

    python -m recipes.studies.libero_smoke                         # random weights: does everything fit together?
    python -m recipes.studies.libero_smoke policy=PATH steps=220   # a policy of `VLAPolicy.save_pretrained`
    python -m recipes.studies.libero_smoke policy=PATH suites=[libero_spatial] steps=220   # a published folder of OpenVLA-OFT

Needs the extra libero, see `torchrl_sparse.envs.libero`, and a GL library. Writes OUT/<suite>.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from torchrl_sparse import keys
from torchrl_sparse.cli.options import Positive, Whole, Word, Words
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.cli.vla import load_vla
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.libero import SUITES, make_libero_env
from torchrl_sparse.evaluation.figures.tokens import draw_tokens, plot_token_strip
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.specprune import SpecPrune

OPTIONS = {"policy": Word | None, "preset": Word, "alpha": Positive, "suites": Words | None, "task_id": Whole}
"""Options that no recipe of the library has, or that may be null here -> type."""
_SHOWN = 6


@recipe("libero_smoke", options=OPTIONS)
def main(config: DictConfig) -> None:
    for suite in config.suites or SUITES:
        print(play(suite, config))


def play(suite: str, config: DictConfig) -> str:
    """Step and draw one suite and return a summary. Each suite loads its own policy, so only one is in memory at a time."""
    policy = make_policy(suite, config).to(config.device)
    policy.pruner = SpecPrune(config.preset, alpha=config.alpha)
    steps = rollout(policy, suite, config)
    queries = steps[steps[keys.QUERIED].squeeze(-1)]
    path = draw(policy, queries, Path(config.out) / f"{suite}.png")
    return (
        f"{suite}, {steps[keys.INSTRUCTION][0]!r}: {len(steps)} steps, {len(queries)} policy calls, "
        f"{queries[keys.KEPT].mean():.0f} visual tokens, success {steps['next', keys.SUCCESS].any().item()}; {path}"
    )


def make_policy(suite: str, config: DictConfig) -> VLAPolicy:
    """Load the policy in a folder with the suite's own action range, or make a small one with random weights."""
    if config.policy is not None:
        return load_vla(config, suite)
    torch.manual_seed(0)
    return VLAPolicy(VLANetwork(VLAConfig.small()))


def rollout(policy: VLAPolicy, suite: str, config: DictConfig) -> TensorDictBase:
    """Run ``steps`` steps of the suite's task and return them, [T]."""
    size = policy.network.config.image_size
    as_released = policy.source.images == "openvla_oft"
    env = make_libero_env(suite, config.task_id, image_size=size, as_released=as_released)
    actor = ChunkExecutor(policy, config.n_action_steps, ActionAwareController())
    collector = Collector(
        env,
        actor,
        frames_per_batch=config.steps,
        total_frames=config.steps,
        auto_register_policy_transforms=True,
        exploration_type=ExplorationType.RANDOM,
        policy_device=config.device,
        storing_device="cpu",
    )
    try:
        return next(iter(collector)).clone()
    finally:
        collector.shutdown()


def draw(policy: VLAPolicy, queries: TensorDictBase, path: Path) -> Path:
    """Draw both cameras at a few policy calls, darker where tokens were dropped."""
    shown = np.unique(np.linspace(0, len(queries) - 1, _SHOWN).round().astype(int)).tolist()
    pictures = [
        draw_tokens(
            queries[index][keys.TOKEN_FRAMES].numpy(),
            queries[index][keys.TOKEN_DEPTH].numpy(),
            policy.network.config.llm.layers,
        )
        for index in shown
    ]
    return plot_token_strip(pictures, [f"policy call {index}" for index in shown], path)


if __name__ == "__main__":
    main()
