#!/usr/bin/env bash
# A consistency scheduler answers the first query rightly and every later one wrongly, without an error.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: the list of steps is set once when the policy is made, as it may be for DDPM and DDIM; a scheduler whose place in the
#   list matters would complain at the second query, as DPM-Solver, UniPC and Euler do (IndexError, AssertionError).
# What happens: `LCMScheduler` counts its steps in a private index that only `set_timesteps` sets back. In the second query
#   every step counts as beyond the end: none leads to a lower noise level, and noise is added even in the last one. With an
#   exact network the first chunk is 0.500 everywhere, the second one 0.227, 0.608, 0.095, -0.155, and so are all after it.
# Hurts: policies distilled to a few steps and served in a loop: the first action chunk of a process is good, no other.
# Live with it: call `set_timesteps` before each query.
# torchrl_sparse: right by design; a `Sampler` cannot be changed and keeps no place.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import LCMScheduler
s = LCMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2")

def query():
    torch.manual_seed(0)
    x = torch.randn(1, 4, 1)
    for t in s.timesteps:
        a = s.alphas_cumprod[t]
        x = s.step((x - a.sqrt() * 0.5) / (1 - a).sqrt(), t, x).prev_sample  # the exact noise where every action is 0.5
    return x.flatten()

s.set_timesteps(4)
first, second = query(), query()
s.set_timesteps(4)
again = query()
for name, found in (("first", first), ("second", second), ("after set_timesteps", again)):
    print(name, [round(v, 3) for v in found.tolist()])
assert (first - 0.5).abs().max() < 1e-4 and torch.equal(first, again)
assert (second - 0.5).abs().max() > 0.2
EOF
