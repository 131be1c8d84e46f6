#!/usr/bin/env bash
# A vector environment swallows one action per episode: the first of the new chunk.
#
# Versions: gymnasium 1.4.0.
# Guess: after an episode's end the next `step` plays its action in the new episode.
# What happens: the default autoreset spends that step on the reset: the action is ignored, reward is 0, flags are false. A policy
#   that plays chunks of four actions 0 1 2 3, asked again at each end, has the new episode begin with action 1. Episodes of
#   3 steps give 3 plays in 4 calls. Which mode is set stands in `env.metadata["autoreset_mode"]`.
# Hurts: chunked policies (every episode but the first starts one action late) and recorded data (one empty step an episode,
#   which looks like any other).
# Live with it: ask again after the reset step, not at the end; or autoreset_mode SAME_STEP.
# torchrl_sparse: not touched; its environments are TorchRL's, where a reset is no step, and executors follow `is_init` by row.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check gymnasium==1.4.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import gymnasium, numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

class Recorder(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(10)

    def __init__(self):
        self.episodes = []

    def reset(self, *, seed=None, options=None):
        self.episodes.append([])
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.episodes[-1].append(int(action))
        return np.zeros(1, np.float32), 1.0, len(self.episodes[-1]) == 3, False, {}

def played(**options):
    env = SyncVectorEnv([Recorder], **options)
    env.reset()
    chunk, rewards = [0, 1, 2, 3], []
    for _ in range(9):
        _, reward, ended, _, _ = env.step(np.array([chunk.pop(0)]))
        rewards.append(float(reward[0]))
        if ended[0] or not chunk:
            chunk = [0, 1, 2, 3]  # the policy is asked again
    return [episode for episode in env.envs[0].episodes if episode], rewards

default, rewards = played()
same, _ = played(autoreset_mode=AutoresetMode.SAME_STEP)
print("default  ", default, "rewards", rewards)
print("same step", same)
assert default[0] == [0, 1, 2] and default[1][0] == 1 and 0.0 in rewards
assert same == [[0, 1, 2]] * 3
EOF
