#!/usr/bin/env bash
# Under MultiAction an episode that ends inside a chunk ends with reward 0, the one reward that a success pays.
#
# Versions: torchrl 0.14.1, tensordict 0.14.3, torch 2.13.0.
# Guess: `MultiAction(stack_rewards=False)` gives a chunk the sum of its steps' rewards, or the last one that was paid.
# What happens: the reward is that of the chunk's last place. Where the episode ended before that place nothing was played
#   there, and the reward is 0, whatever the ending step paid. Of 10 steps that pay 1 each, in chunks of four, rewards of 1, 1
#   and 0 are seen; `done` and the observation are right. A `RewardSum` outside says 2.
# Hurts: tasks with a sparse reward: an episode is counted as a failure unless its success falls on a chunk's last place,
#   which is one in four here and one in eight of Diffusion Policy's chunks.
# Live with it: `RewardSum` before `MultiAction` in the chain of transforms, and read `episode_reward`; a success flag of one's own.
# torchrl_sparse: right; `ChunkExecutor` plays a chunk step by step, so that every reward is the environment's, and a test adds them up.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 tensordict==0.14.3 torchrl==0.14.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import logging
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, MultiAction, RewardSum, TransformedEnv
logging.disable(logging.WARNING)

class Count(EnvBase):
    """Observes how many steps were played and pays 1 for each; an episode ends after `last`."""

    def __init__(self, last):
        super().__init__(device="cpu")
        self.last, self.played = last, 0
        self.observation_spec = Composite(observation=Unbounded(1))
        self.action_spec, self.reward_spec = Unbounded(1), Unbounded(1)
        self.done_spec = Composite({k: Binary(1, dtype=torch.bool) for k in ("done", "terminated", "truncated")})

    def _reset(self, td=None, **options):
        self.played = 0
        return TensorDict(dict(observation=torch.zeros(1)), [])

    def _step(self, td):
        self.played += 1
        done = torch.tensor([self.played >= self.last])
        return TensorDict(dict(
            observation=torch.tensor([float(self.played)]), reward=torch.ones(1),
            done=done, terminated=done, truncated=torch.zeros_like(done),
        ), [])

    def _set_seed(self, seed):
        pass

chunk = TensorDictModule(lambda seen: torch.zeros(4, 1), in_keys=["observation"], out_keys=["action"])

def rollout(last, *transforms):
    env = Count(last)
    found = TransformedEnv(env, Compose(*transforms)).rollout(100, chunk)["next"]
    assert env.played == last and bool(found["done"][-1])
    return found

for last in (10, 12):
    outside = rollout(last, MultiAction(stack_rewards=False), RewardSum())
    inside = rollout(last, RewardSum(), MultiAction(stack_rewards=False))
    print(f"{last} steps that pay 1 each: rewards", outside["reward"].flatten().tolist(),
          "sum outside", outside["episode_reward"][-1].item(), "sum inside", inside["episode_reward"][-1].item())
    assert outside["reward"].flatten().tolist() == [1, 1, 1 if last == 12 else 0]
    assert inside["episode_reward"][-1].item() == last
EOF
