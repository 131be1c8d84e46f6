#!/usr/bin/env bash
# One task on which two policies never differ makes all other tasks' evidence count for nothing.
#
# Versions: scipy 1.17.1, numpy 2.4.6.
# Guess: combining p = 1e-6, 1e-6 and 1 over three tasks by Stouffer's method leaves a small p.
# What happens: p = 1 is minus infinity on Stouffer's scale, so the combined p is exactly 1. Exact tests of paired successes say
#   p = 1 wherever wins equal losses, which is common. Weights do not help. Fisher's method says 4e-10 of the same three.
# Hurts: tables over tasks whose "combined p" is 1.0, however clear the rest is.
# Live with it: pool the pairs of all tasks in one stratified test instead of combining p-values.
# torchrl_sparse: combines no p-values; several tasks are put together by their pairs, task by task.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from scipy.stats import binomtest, combine_pvalues

same = binomtest(3, 6).pvalue
print("p of 3 won and 3 lost:", same)
found = {}
for method in ("stouffer", "fisher"):
    found[method] = float(combine_pvalues([1e-6, 1e-6, same], method=method).pvalue)
    print(f"{method}: p of 1e-6, 1e-6 and that = {found[method]:.2g}")
weighted = float(combine_pvalues([1e-6, 1e-6, same], method="stouffer", weights=[100, 100, 1]).pvalue)
print("stouffer, a hundredth of the weight on it:", weighted)
assert same == 1 and found["stouffer"] == 1 and weighted == 1
assert found["fisher"] < 1e-8
EOF
