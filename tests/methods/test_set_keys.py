"""An environment with names of its own: what plays in it is what plays under the default names."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv

from tests.fixtures.diffusion import SIZES
from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Normalizer, Sampler, keys
from torchrl_sparse.blocks.planner import Dense
from torchrl_sparse.envs.transforms import state_history

STATE, ACTION = ("robot", "proprio"), ("arm", "command")


class Drift(EnvBase):
    """Its state is moved by the mean of the action."""

    def __init__(self, state, action):
        super().__init__()
        self.names = state, action
        count = Unbounded(1, dtype=torch.int64)
        episode = {"seed": count, "step": count.clone()}
        self.observation_spec = Composite({state: Unbounded(SIZES["cond_dim"]), "episode": episode})
        self.action_spec = Composite({action: Unbounded(10)})
        self.reward_spec = Unbounded(1)

    def _observe(self):
        now = {"seed": torch.tensor([7]), "step": torch.tensor([self.count])}
        return TensorDict({self.names[0]: self.state.clone(), "episode": now})

    def _reset(self, tensordict):
        self.state, self.count = torch.zeros(SIZES["cond_dim"]), 0
        return self._observe()

    def _step(self, tensordict):
        self.state, self.count = self.state + tensordict[self.names[1]].mean(), self.count + 1
        done = torch.tensor([self.count == 6])
        return self._observe().update({"reward": torch.zeros(1), "done": done, "terminated": done})

    def _set_seed(self, seed):
        pass


def wrapped(state=keys.STATE, action=keys.ACTION):
    return TransformedEnv(Drift(state, action), Compose(InitTracker(), *state_history(2, state)))


@pytest.fixture
def policy(make_network):
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(10), torch.zeros(10))
    return DiffusionPolicy(make_network(n_layer=1), normalizer, sampler=Sampler("ddpm", 3, spacing="logsnr"))


@pytest.fixture
def renamed(policy):
    policy = policy.with_plan(Dense())
    policy.set_keys(state=STATE)
    actor = ChunkExecutor(policy, 3)
    actor.set_keys(action=ACTION)
    return actor


def collected(env, actor):
    collector = Collector(
        env, actor, frames_per_batch=12, total_frames=12, auto_register_policy_transforms=True
    )
    try:
        return next(iter(collector))
    finally:
        collector.shutdown()


@pytest.mark.parametrize("play", [lambda env, actor: env.rollout(6, actor), collected])
def test_an_environment_with_other_names_is_played_as_one_with_the_default_names(policy, renamed, play):
    plain, other = play(wrapped(), ChunkExecutor(policy, 3)), play(wrapped(STATE, ACTION), renamed)
    assert plain[keys.ACTION].abs().sum() > 0
    assert torch.equal(other[ACTION], plain[keys.ACTION])
    assert torch.equal(other["history", "proprio"], plain[keys.HISTORY_STATE])
    assert other.get(keys.ACTION, None) is None


def test_every_copy_keeps_the_names(renamed):
    copies = copy.deepcopy(renamed), pickle.loads(pickle.dumps(renamed))
    policies = [other.policy for other in copies]
    for policy in (*policies, renamed.policy.with_plan(Dense()), renamed.policy.with_noise(1)):
        assert ("history", "proprio") in policy.in_keys
        assert keys.HISTORY_STATE not in policy.in_keys
    assert all(ACTION in other.out_keys and keys.ACTION not in other.out_keys for other in copies)
    renamed.policy.set_keys(state=None)
    assert renamed.policy.in_keys[0] == keys.HISTORY_STATE


def test_unknown_names_are_refused(renamed):
    with refused("set_keys"):
        renamed.policy.set_keys(state="other", stat="x")
    with refused("set_keys"):
        renamed.set_keys(state="x")
    assert ("history", "proprio") in renamed.policy.in_keys
