#!/usr/bin/env bash
# In bfloat16 the first noise levels of training hold no noise at all.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: noising bf16 actions costs a rounding of the result, a third decimal.
# What happens: the table of signal shares is rounded to bf16 before 1 - share is taken. A share above 0.998 becomes 1, so
#   the noise's factor is exactly 0 at timesteps 0 and 1 of 100 (0.025 and 0.042 in f32), 0.0625 at both 2 and 3, and 0 at
#   21 of 1,000 timesteps. The training target there is noise that is not in the input.
# Hurts: trainings of diffusion policies in pure bf16, and most the last denoising steps, whose precision the robot feels;
#   nothing warns, the loss just stays high at those timesteps.
# Live with it: noise in f32 and cast the result; autocast does not help where the batch itself is bf16.
# torchrl_sparse: had the same zeros; `Sampler.add_noise` makes both factors in f32 since, and a test compares them.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import DDPMScheduler
for steps, without in ((100, 2), (1000, 21)):
    s = DDPMScheduler(num_train_timesteps=steps, beta_schedule="squaredcos_cap_v2")
    t = torch.arange(steps)
    factor = {d: s.add_noise(torch.zeros(steps, 1, dtype=d), torch.ones(steps, 1, dtype=d), t)[:, 0] for d in (torch.float32, torch.bfloat16)}
    print(steps, "f32 ", [round(x, 4) for x in factor[torch.float32][:4].tolist()], "without noise:", int((factor[torch.float32] == 0).sum()))
    print(steps, "bf16", [round(x, 4) for x in factor[torch.bfloat16][:4].tolist()], "without noise:", int((factor[torch.bfloat16] == 0).sum()))
    assert (factor[torch.float32] > 0).all()
    assert int((factor[torch.bfloat16] == 0).sum()) == without
EOF
