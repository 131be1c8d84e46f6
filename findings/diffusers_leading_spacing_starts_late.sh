#!/usr/bin/env bash
# With the default spacing, 51 denoising steps of 100 begin half-way: pure noise is taken for a half-clean action.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: the steps of any number are spread over all 100 timesteps, and the first one is nearly pure noise.
# What happens: the gap between timesteps is 100 // steps. 50 steps begin at timestep 98, 51 at 50, where the network was
#   trained on actions with 0.69 of their amplitude in them and is now shown noise alone. 34 begin at 66 (0.49), 60 at 59
#   (0.58), and 1 at timestep 0, where hardly any noise is expected. DDPM and DDIM alike; nothing warns.
# Hurts: tables of success over the number of steps, which dip where it does not divide 100, and short chains: 2 steps
#   begin at 50, 3 at 66.
# Live with it: numbers of steps that divide the training's, or `timestep_spacing="trailing"`.
# torchrl_sparse: samples as diffusers does, and warns with the timestep and the amplitude; spacing "logsnr" begins at 91 of 100.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from diffusers import DDIMScheduler, DDPMScheduler

for kind in (DDPMScheduler, DDIMScheduler):
    s = kind(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2")
    firsts = {}
    for steps in (1, 2, 3, 10, 34, 50, 51, 60):
        s.set_timesteps(steps)
        first = firsts[steps] = int(s.timesteps[0])
        print(f"{kind.__name__} {steps:2} steps begin at {first:2}, amplitude of the action there {float(s.alphas_cumprod[first]) ** 0.5:.2f}")
    assert firsts == {1: 0, 2: 50, 3: 66, 10: 90, 34: 66, 50: 98, 51: 50, 60: 59}
s = DDIMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", timestep_spacing="trailing")
s.set_timesteps(51)
print("trailing, 51 steps begin at", int(s.timesteps[0]))
assert int(s.timesteps[0]) == 99
EOF
