#!/usr/bin/env bash
# A sweep that forgets to say "maximize" stops its best run and keeps its worst.
#
# Versions: sweeps 0.3.0, the engine of W&B's sweeps.
# Guess: `metric: {name: success}` without a goal is refused, or early termination waits.
# What happens: the goal is "minimize". Of three runs with final success 0.9, 0.5 and 0.0, hyperband (min_iter 2, eta 2) stops the one
#   with 0.9. With `goal: maximize` it stops the one with 0.0. Both files are valid and nothing is said.
# Hurts: sweeps over success rates, the metric of robot learning, which are all written after examples with a loss.
# Live with it: always write the goal.
# torchrl_sparse: refuses a search (method bayes) whose file names no goal.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check sweeps==0.3.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from sweeps import RunState, SweepRun, stop_runs
histories = {
    "good": [0.1, 0.2, 0.5, 0.8, 0.8, 0.9, 0.9, 0.9],
    "middle": [0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5],
    "bad": [0.0] * 8,
}

def stopped(metric):
    runs = [
        SweepRun(name=name, state=RunState.running, config={"x": {"value": 0.1}}, history=[{"success": v} for v in values])
        for name, values in histories.items()
    ]
    sweep = {
        "method": "random",
        "metric": metric,
        "parameters": {"x": {"min": 0.0, "max": 1.0}},
        "early_terminate": {"type": "hyperband", "min_iter": 2, "eta": 2},
    }
    return [run.name for run in stop_runs(sweep, runs)]

without, with_goal = stopped({"name": "success"}), stopped({"name": "success", "goal": "maximize"})
print("no goal:", without, " goal maximize:", with_goal)
assert without == ["good"] and with_goal == ["bad"]
EOF
