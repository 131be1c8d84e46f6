#!/usr/bin/env bash
# A stochastic chain that does not end at timestep 0 adds noise to its answer, where the variance is the large one.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: the last step of DDPM returns the clean prediction, whatever its timestep.
# What happens: noise is left out at timestep 0 alone. At another last timestep, as trailing spacing and chosen timesteps
#   have it, `fixed_large` adds noise of the training step's own size: 0.20 at timestep 11 of 100, of actions in [-1, 1].
#   With `fixed_small` the same line adds 1e-10.
# Hurts: policies with `variance_type: fixed_large` at few steps: actions tremble, and success falls for no fault of the network.
# Live with it: `fixed_small`, or a list of timesteps that ends with 0.
# torchrl_sparse: right; a last step adds nothing wherever it begins, and `fixed_large` in a checkpoint is refused by name.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import DDPMScheduler

def spread(variance, timesteps):
    s = DDPMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", variance_type=variance)
    s.set_timesteps(timesteps=timesteps)
    torch.manual_seed(0)
    nothing = torch.zeros(1, 10_000)
    found = s.step(nothing, timesteps[-1], nothing).prev_sample.std().item()
    print(f"{variance}, last timestep {timesteps[-1]:2}: noise of {found:.1e} in the answer")
    return found

assert spread("fixed_small", [91, 71, 51, 31, 11]) < 1e-9
assert 0.19 < spread("fixed_large", [91, 71, 51, 31, 11]) < 0.21
assert spread("fixed_large", [91, 71, 51, 31, 0]) == 0
EOF
