#!/usr/bin/env bash
# A flow-matching schedule is shifted twice: the defaults, and noise levels that the caller hands in.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: with `shift=3` the schedule is shifted once, and `set_timesteps(sigmas=[...])` takes the levels as they are.
# What happens: the constructor shifts its table and keeps its ends; `set_timesteps` spaces levels between those ends and
#   shifts them again. With 100 training steps the least level is 0.029 in the table and 0.083 in a schedule of ten steps
#   (shift 5: 0.048 and 0.202), so the last step leaps from three to four times the noise. Levels [1.0, 0.5] come out as
#   [1.0, 0.75]. At 1,000 steps and shift 1 there is nothing to see, which is why it goes unnoticed.
# Hurts: flow-matching policies with few training levels and a shift: the last network call is asked far from the data.
# Live with it: hand in levels that are un-shifted, s / (shift - (shift - 1) s), or set shift to 1 and shift yourself.
# torchrl_sparse: has no flow-matching sampler of this class; it plays diffusion policies, whose timesteps it tabulates itself.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 scipy==1.17.1 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from diffusers import FlowMatchEulerDiscreteScheduler as Flow
for shift, table, schedule in ((1, 0.01, 0.01), (3, 0.0294, 0.0833), (5, 0.0481, 0.2016)):
    s = Flow(num_train_timesteps=100, shift=shift)
    least = s.sigma_min
    s.set_timesteps(10)
    print("shift", shift, "least level of the table", round(least, 4), "of ten steps", round(s.sigmas[-2].item(), 4))
    assert abs(least - table) < 1e-4 and abs(s.sigmas[-2].item() - schedule) < 1e-4
s = Flow(shift=3.0)
s.set_timesteps(sigmas=[1.0, 0.5])
print("handed in [1.0, 0.5], used", s.sigmas.tolist())
assert s.sigmas.tolist() == [1.0, 0.75, 0.0]
EOF
