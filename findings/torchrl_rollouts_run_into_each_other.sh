#!/usr/bin/env bash
# Two rollouts in one replay buffer become one trajectory, and windows begin in the one and end in the other.
#
# Versions: torchrl 0.14.1, tensordict 0.14.3, torch 2.13.0.
# Guess: `rollout(max_steps)` marks its last step as truncated, or `SliceSampler` knows where one `extend` ended.
# What happens: neither. A rollout that was cut off has `done` and `truncated` false on its last step, and the sampler goes by that flag: of two
#   rollouts of 7 steps a good quarter of the windows of four cross from the first into the second.
# Hurts: histories, chunks and recurrent states that are trained across a reset of the world, with a jump in every such window.
# Live with it: a `StepCounter(max_steps)` in the environment, which truncates, or a trajectory number and `traj_key`.
# torchrl_sparse: right; its windows are made for each demonstration, and its environments truncate at their horizon.
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
from torchrl.data import Binary, Composite, LazyTensorStorage, ReplayBuffer, SliceSampler, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
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

def crossing(make):
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=4, end_key=("next", "done"))
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), sampler=sampler, batch_size=4000)
    for _ in range(2):
        rollout = make().rollout(7)
        buffer.extend(rollout.select("observation", ("next", "done")))
    windows = buffer.sample()["observation"].view(-1, 4)
    torn = (windows.diff(dim=1) != 1).any(1)
    print("last step done:", bool(rollout["next", "done"][-1]), " windows across two rollouts:", torn.float().mean().item(),
          windows[torn][:1].tolist())
    return torn.float().mean().item()

assert crossing(lambda: Count(1000)) > 0.2
assert crossing(lambda: TransformedEnv(Count(1000), StepCounter(max_steps=7))) == 0
EOF
