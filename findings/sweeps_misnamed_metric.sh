#!/usr/bin/env bash
# A Bayesian sweep whose metric is misspelt goes on to the end as if it searched.
#
# Versions: sweeps 0.3.0, the engine of W&B's sweeps.
# Guess: a metric that no finished run has reported is an error after the first run, or a warning.
# What happens: missing values are imputed, so every run looks equally good and the "search" wanders. Twelve runs of a loss with
#   its least at x = 0.2: rightly named, at least five of the last six lie within 0.1 of it; as "Loss" instead of "loss" at most
#   three do. Every run is finished, every proposal valid, no word in either case.
# Hurts: sweeps over metrics with long dotted names (task, method, measure), which are easy to misspell; days of trials.
# Live with it: compare the metric's name with the first finished run's summary before the second one starts.
# torchrl_sparse: refuses a search by a metric that its first trial did not report, and names those there are.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check sweeps==0.3.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import numpy as np
from sweeps import RunState, next_run

def search(name):
    np.random.seed(0)
    sweep = {"method": "bayes", "metric": {"name": name, "goal": "minimize"}, "parameters": {"x": {"min": 0.0, "max": 1.0}}}
    runs = []
    for _ in range(12):
        run = next_run(sweep, runs)
        run.state, run.summary_metrics = RunState.finished, {"loss": (run.config["x"]["value"] - 0.2) ** 2}
        runs.append(run)
    return [round(float(run.config["x"]["value"]), 2) for run in runs]

near = {}
for name in ("loss", "Loss"):
    found = search(name)
    near[name] = sum(abs(x - 0.2) < 0.1 for x in found[6:])
    print(name, found, "near the least loss in the last six:", near[name])
assert near["loss"] >= 5 and near["Loss"] <= 3
EOF
