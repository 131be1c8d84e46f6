#!/usr/bin/env bash
# `thresholding=True` on its own does exactly what `clip_sample=True` does, whatever the ratio.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: dynamic thresholding scales a chunk down by its 99.5 % quantile, so a reach of 3 keeps its shape: 3, 1.5, 0 becomes
#   1, 0.5, 0.
# What happens: the quantile is held between 1 and `sample_max_value`, whose default is 1.0. The scale is always 1, and what
#   is left is a clamp to [-1, 1]: 1, 1, 0. `dynamic_thresholding_ratio` 0.5 and 0.995 give the same bits. And with
#   `sample_max_value=3` the same chunk does keep its shape, and `clip_sample=True` beside it is then ignored.
# Hurts: studies of clipping against thresholding in few steps: they compare a method with itself.
# Live with it: set `sample_max_value` together with `thresholding`; mind that one action of a chunk then shrinks all others.
# torchrl_sparse: offers no thresholding and refuses a checkpoint whose configuration asks for it.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers import DDPMScheduler
chunk = torch.tensor([3.0, 1.5, 0.5, 0.0, -3.0]).view(1, 5, 1)

def clean(**options):
    s = DDPMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", prediction_type="sample", **options)
    return s.step(chunk, 0, chunk).pred_original_sample.flatten()

clipped = clean(clip_sample=True)
print("clip_sample           ", clipped.tolist())
for ratio in (0.5, 0.995):
    found = clean(clip_sample=False, thresholding=True, dynamic_thresholding_ratio=ratio)
    print(f"thresholding, {ratio:<5}   ", found.tolist())
    assert torch.equal(found, clipped)
wide = clean(clip_sample=True, thresholding=True, sample_max_value=3.0)
print("both, sample_max_value=3", [round(v, 3) for v in wide.tolist()])
assert torch.allclose(wide, chunk.flatten() / 3)
EOF
