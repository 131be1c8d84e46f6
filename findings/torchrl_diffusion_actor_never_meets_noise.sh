#!/usr/bin/env bash
# TorchRL's diffusion actor begins at pure noise, and its schedule ends long before that.
#
# Versions: torchrl 0.14.1, tensordict 0.14.3, torch 2.13.0.
# Guess: `DiffusionActor(num_steps=K)` scales its noise schedule to K steps, so that the noisiest step is nearly pure noise.
# What happens: the betas run from 1e-4 to 0.02 whatever K, the values of a thousand steps. At the last of the default 100 steps 0.60 of
#   the action's amplitude is still there, of 10 steps 0.95. Training shows the network no more noise than that, and sampling then
#   begins with noise alone.
# Hurts: policies of few steps: samples are too wide and partly made of what the network never saw, which looks like a weak policy.
# Live with it: hand in `beta_end` for the number of steps: 0.2 with 100 leaves 0.005 of the amplitude.
# torchrl_sparse: right; the squared cosine schedule of diffusion policies, which ends in noise whatever its length.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 tensordict==0.14.3 torchrl==0.14.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import logging
logging.disable(logging.WARNING)
from torchrl.modules import DiffusionActor

def amplitude(steps, **options):
    buffers = dict(DiffusionActor(action_dim=2, obs_dim=3, num_steps=steps, **options).named_buffers())
    found = buffers["module.alphas_cumprod"][-1].item() ** 0.5
    print(f"{steps} steps {options or ''}: amplitude of the action at the noisiest step {found:.3f}")
    return found

assert amplitude(1000) < 0.01
assert 0.59 < amplitude(100) < 0.62
assert 0.94 < amplitude(10) < 0.96
assert amplitude(100, beta_end=0.2) < 0.01
EOF
