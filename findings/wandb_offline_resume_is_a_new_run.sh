#!/usr/bin/env bash
# Offline, a resumed W&B run is a new one that begins at step 0, even where resuming is a must.
#
# Versions: wandb 0.31.0.
# Guess: `wandb.init(id=..., resume="must")` in offline mode goes on where the folder's earlier run stopped, or raises.
# What happens: nothing of the earlier run is looked at. `resumed` is False, `step` is 0, the summary is empty, and a second folder
#   with the same id lies beside the first; "must" raises nothing, with an id that never was either.
# Hurts: trainings on machines without a network that are killed and resumed: a loop that logs without `step=` numbers its second
#   half from 0, and a best value kept in the summary is forgotten.
# Live with it: keep the step in the checkpoint and log with `step=`, and the best value there too.
# torchrl_sparse: right; its trainers log every line with the step of their checkpoint, and keep nothing in W&B that they read.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check wandb==0.31.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import os, pathlib
os.environ.update(WANDB_MODE="offline", WANDB_SILENT="true")
import wandb

def run(name, resume, log=0):
    made = wandb.init(project="trap", id=name, resume=resume, dir=".")
    found = (made.resumed, made.step, dict(made.summary))
    for value in range(log):
        made.log({"loss": value})
    step = made.step
    made.finish()
    return found, step

_, step = run("abc", "allow", log=5)
print("first run ended at step", step)
assert step == 5
for name, resume in (("abc", "allow"), ("abc", "must"), ("never", "must")):
    found, _ = run(name, resume)
    print(f"resume={resume!r} of {name!r}: resumed, step, summary =", found)
    assert found == (False, 0, {})
print(len(list(pathlib.Path("wandb").glob("offline-run-*-abc"))), "folders of one id")
EOF
