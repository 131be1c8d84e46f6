#!/usr/bin/env bash
# DDIM lands between its own timesteps when the steps do not divide the training steps.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: a DDIM step leads to the timestep that the network is asked at next.
# What happens: it leads a fixed stride (training steps // steps, rounded down) back. With spacing "trailing" or "linspace"
#   the list is uneven or has another stride, so the noise that is left and the timestep that the network is told differ.
#   With 6 of 100 steps, "linspace", and an exact network for actions of mean 0.5 and deviation 0.2, the samples have mean
#   0.473 and deviation 0.214; the same timesteps stepped to one another give 0.499 and 0.114. "leading" agrees exactly.
#   DDPM in the same package looks the next timestep up and has no such gap.
# Hurts: whoever cuts a diffusion policy to few steps with a trailing or linspace schedule: mean off by 5 %, no message.
# Live with it: take steps that divide the training steps and spacing "leading" ("trailing" is right too where they divide).
# torchrl_sparse: right; its sampler steps from each timestep to the next one of its list, for any list that falls.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import DDIMScheduler
MEAN, DEVIATION, STEPS = 0.5, 0.2, 6

def exact_noise(x, abar):
    return (1 - abar).sqrt() * (x - abar.sqrt() * MEAN) / (abar * DEVIATION**2 + 1 - abar)

def sample(spacing, look_up):
    s = DDIMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", timestep_spacing=spacing, clip_sample=False)
    s.set_timesteps(STEPS)
    x = torch.randn(20000, 1, generator=torch.Generator().manual_seed(0))
    times = s.timesteps.tolist()
    for now, after in zip(times, times[1:] + [-1]):
        a = s.alphas_cumprod[now]
        eps = exact_noise(x, a)
        if look_up:
            b = s.alphas_cumprod[after] if after >= 0 else torch.tensor(1.0)
            x = b.sqrt() * (x - (1 - a).sqrt() * eps) / a.sqrt() + (1 - b).sqrt() * eps
        else:
            x = s.step(eps, now, x).prev_sample
    return times, round(x.mean().item(), 3), round(x.std().item(), 3)

found = {(spacing, look): sample(spacing, look) for spacing in ("leading", "linspace", "trailing") for look in (False, True)}
for (spacing, look), (times, mean, deviation) in found.items():
    print(f"{spacing:9} {'next of the list' if look else 'scheduler.step  '} {times} mean {mean} deviation {deviation}")
assert found["leading", False] == found["leading", True]
assert abs(found["linspace", False][1] - found["linspace", True][1]) > 0.02
assert abs(found["trailing", False][2] - found["trailing", True][2]) > 0.02
EOF
