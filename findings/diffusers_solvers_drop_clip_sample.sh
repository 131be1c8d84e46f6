#!/usr/bin/env bash
# Changing the scheduler with `from_config` keeps `clip_sample` in the configuration and stops clipping.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: a policy trained with clip_sample=True stays within [-1, 1] whatever scheduler its configuration is handed to.
# What happens: DPM-Solver (multi- and single-step), UniPC and DEIS keep the entry (`config.clip_sample` is still True) and
#   never read it. The squared-cosine schedule begins with a signal share of 2.4e-7, a division by 0.0005: a network whose
#   noise is 10 % off gives actions up to 1, with DDIM, and 2,470 with the solvers, in five steps. DDIM and LCM do clip.
# Hurts: who replaces DDPM by a fast solver for a robot: the normalised action is nowhere near its bounds, the un-normalised
#   one saturates every joint, and the configuration says that it is clipped.
# Live with it: clip the clean prediction yourself (a model wrapper that returns it with prediction_type="sample").
# torchrl_sparse: right; all its samplers, its solvers too, clip the clean prediction in every step, and the page says so.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 scipy==1.17.1 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DEISMultistepScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler
trained = DDPMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", clip_sample=True)
largest = {}
for kind in (DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler, DEISMultistepScheduler):
    s = kind.from_config(trained.config)
    s.set_timesteps(5)
    x = torch.randn(1, 8, 2, generator=torch.Generator().manual_seed(0))
    for t in s.timesteps:
        x = s.step(0.9 * x / max(1.0, float(x.abs().max())), t, x).prev_sample
    largest[kind.__name__] = float(x.abs().max())
    print(f"{kind.__name__:28} config.clip_sample {s.config.clip_sample}, largest action {largest[kind.__name__]:.4g}")
    assert s.config.clip_sample is True
assert largest.pop("DDIMScheduler") <= 1
assert all(value > 100 for value in largest.values())
EOF
