#!/usr/bin/env bash
# A quantised range gives its two ends half the chance of every number between.
#
# Versions: sweeps 0.3.0, the engine of W&B's sweeps.
# Guess: `q_uniform` from 0 to 4 in ones draws each of the five numbers as often, as `min: 0, max: 4` does.
# What happens: a uniform number is rounded to the nearest multiple, and the two ends have half of a cell each: of 4,000 draws
#   some 500 are 0, some 500 are 4, and 1,000 each between. Integers of `min` and `max` come some 800 times each.
# Hurts: searches whose ends matter: "no steps cached", "every block skipped", the smallest and the largest chunk.
# Live with it: whole numbers as `min` and `max`, other steps as `values`; or a range half a step wider.
# torchrl_sparse: leaves drawing to the engine; none of its own sweep files is quantised.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check sweeps==0.3.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import collections
from sweeps import next_run

def draws(parameter):
    sweep = {"method": "random", "parameters": {"x": parameter}}
    return collections.Counter(int(next_run(sweep, []).config["x"]["value"]) for _ in range(4000))

quantised = draws({"distribution": "q_uniform", "min": 0, "max": 4, "q": 1})
whole = draws({"min": 0, "max": 4})
print("q_uniform:", sorted(quantised.items()), "integers:", sorted(whole.items()))
assert quantised[0] < 650 and quantised[4] < 650 and quantised[2] > 850
assert min(whole.values()) > 650
EOF
