#!/usr/bin/env bash
# A window of a short episode is drawn many times as often as one of a long episode.
#
# Versions: torchrl 0.14.1, tensordict 0.14.3, torch 2.13.0.
# Guess: `SliceSampler` draws every window of the buffer equally often, as a shuffled data set of windows does.
# What happens: it draws an episode first, whatever its length, and then a window of it. Beside an episode of 100 steps one of 10 gives half of
#   the batch, each of its windows fourteen times as often as the other's. And episodes that are shorter than a window are left out without
#   a word; with `strict_length=False` they come, and a batch of 64 is then smaller than 64.
# Hurts: behaviour cloning from demonstrations of mixed length: fast demonstrators count more than is thought, and a learning curve is not
#   that of shuffled windows.
# Live with it: draw the windows' starts oneself, or take it as a weighting and say so.
# torchrl_sparse: right; its trainer draws every step of every demonstration once an epoch, short episodes padded as published.
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
from torchrl.envs import EnvBase
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

def share(short, window, batch, **options):
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=window, end_key=("next", "done"), **options)
    buffer = ReplayBuffer(storage=LazyTensorStorage(1000), sampler=sampler, batch_size=batch)
    for length, first in ((short, 0), (100, 1000)):
        rollout = Count(length).rollout(length).select("observation", ("next", "done"))
        buffer.extend(rollout.set("observation", rollout["observation"] + first))
    sample = buffer.sample()
    return (sample["observation"] < 1000).float().mean().item(), len(sample)

found, _ = share(short=10, window=4, batch=8000)
print(f"7 windows of the short episode beside 97 of the long one: {found:.2f} of the batch, {7 / 104:.2f} of all windows")
assert 0.45 < found < 0.55
found, size = share(short=3, window=8, batch=64)
print(f"an episode shorter than a window: {found:.2f} of a batch of {size}")
assert found == 0 and size == 64
found, size = share(short=3, window=8, batch=64, strict_length=False)
print(f"with strict_length=False: {found:.2f} of a batch of {size}")
assert found > 0 and size < 64
EOF
