#!/usr/bin/env bash
# Trained beyond its planned steps, the cosine's learning rate climbs back to where it began.
#
# Versions: diffusers 0.42.1, torch 2.13.0.
# Guess: after `num_training_steps` the learning rate stays at 0, as the linear and polynomial schedules' does.
# What happens: the cosine goes on as a wave. After 100 planned steps of which 10 warm up it is 0 at step 100, 0.12 of the peak
#   at 120, 0.59 at 150 and the whole peak at 190.
# Hurts: a training of a diffusion policy that is resumed for more epochs than the scheduler was made for: a finished policy
#   is driven away again, at a full learning rate, and its averaged weights with it.
# Live with it: make the scheduler for all steps, and compare `last_epoch` with them.
# torchrl_sparse: right; its schedule ends at 0, and a longer run of the same folder goes on along a cosine that ends at its own end.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 diffusers==0.42.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import torch
from diffusers.optimization import get_scheduler

def rates(name):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = get_scheduler(name, optimizer, num_warmup_steps=10, num_training_steps=100)
    found = []
    for _ in range(201):
        found.append(schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()
    return found

for name in ("cosine", "linear", "polynomial"):
    found = rates(name)
    print(f"{name:10}", {step: round(found[step], 2) for step in (10, 55, 100, 120, 150, 190)})
    assert found[100] < 1e-6
    assert (found[190] > 0.99) == (name == "cosine")
EOF
