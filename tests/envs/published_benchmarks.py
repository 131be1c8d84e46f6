"""Rolling out an untrained policy of a task's published shape, and what every environment of a benchmark has to do."""

import sys
from collections.abc import Sequence

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Normalizer, Sampler, keys, make_env
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.training.diffusion.published import published_network, published_shape


def collected_by_published_policy(
    task: str, frames: int, action_scale: Sequence[float], action_offset: Sequence[float]
):
    """Steps [frames] that a TorchRL collector gathers with an untrained policy of the published shape, two denoising steps."""
    torch.manual_seed(0)
    network = published_network(task)
    scale = torch.full((find_task(task).state_dim,), 0.01)
    normalizer = Normalizer(
        scale, torch.zeros_like(scale), torch.tensor(action_scale), torch.tensor(action_offset)
    )
    policy = DiffusionPolicy(network, normalizer, sampler=Sampler("ddim", 2))
    actor = ChunkExecutor(policy, published_shape(task).n_action_steps)
    env = make_env(task, seeds=[100000], n_obs_steps=network.n_obs_steps)
    collector = Collector(
        env, actor, frames_per_batch=frames, total_frames=frames, auto_register_policy_transforms=True
    )
    try:
        return next(iter(collector))
    finally:
        collector.shutdown()


def check_seeds_fix_episodes(make, action):
    """Same seed, same episode, to the last bit; another seed, another episode."""
    env = make(seeds=[7, 8, 7])
    episodes = [_play(env, action) for _ in range(3)]
    env.close()
    again = make()
    again.set_seed(7)
    episodes.append(_play(again, action))
    assert int(again.reset()[keys.EPISODE_SEED]) == 8
    again.close()
    assert torch.equal(episodes[0], episodes[2])
    assert torch.equal(episodes[0], episodes[3])
    assert not torch.equal(episodes[0][0], episodes[1][0])


def _play(env: EnvBase, action: torch.Tensor) -> torch.Tensor:
    td = env.reset()
    states = [td[keys.STATE]]
    for _ in range(5):
        td = env.step(td.set(keys.ACTION, action))["next"]
        states.append(td[keys.STATE])
    return torch.stack(states)


def check_horizon_and_errors(make, action):
    """Truncated at the horizon, not terminated; wrong actions and seeds are named."""
    env = make(horizon=3, seeds=[1])
    steps = env.rollout(9, lambda td: td.set(keys.ACTION, action))["next"]
    assert steps["truncated"].flatten().tolist() == [False, False, True]
    assert not steps["terminated"].any()
    assert steps["done"][-1]
    assert steps[keys.EPISODE_STEP].flatten().tolist() == [1, 2, 3]
    size = len(action)
    with refused("action"):
        env._step(env.reset().set(keys.ACTION, torch.zeros(size + 1)))
    with refused("action"):
        env._step(env.reset().set(keys.ACTION, torch.full((size,), float("nan"))))
    env.close()
    with refused("seeds"):
        make(seeds=[])


def check_missing_extra_is_named(make, monkeypatch, package: str, extra: str):
    """As if the simulator were not installed."""
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"pip install 'torchrl-sparse\[{extra}\]'"):
        make()
