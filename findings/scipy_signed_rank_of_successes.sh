#!/usr/bin/env bash
# The signed-rank test of two policies' successes has half the p that it should, and none where they never differ.
#
# Versions: scipy 1.17.1, numpy 2.4.6.
# Guess: `scipy.stats.wilcoxon` of paired successes is exact at nine differences, and 1 of policies that never differ.
# What happens: with zeros or ties among the differences, and successes have little else, it takes a normal approximation
#   without a continuity correction. 8 of 300 episodes won and 1 lost give p = 0.020; the exact test of 8 to 1 says 0.039.
#   4 to 0 give 0.046, exactly 0.125. Of policies that never differ p is NaN.
# Hurts: paired evaluations: four episodes in a row are "significant", and a table of p-values has holes where policies agree.
# Live with it: McNemar's exact test, `scipy.stats.binomtest(won, won + lost)`.
# torchrl_sparse: right; its p is McNemar's exact one, 1 of policies that never differ, and a test has these counts.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import math
import numpy as np
from scipy.stats import binomtest, wilcoxon

def both(won, lost, episodes=300):
    differences = np.zeros(episodes)
    differences[:won], differences[won : won + lost] = 1, -1
    exact = binomtest(won, won + lost).pvalue if won + lost else 1.0
    rank = float(wilcoxon(differences).pvalue)
    print(f"{won} won and {lost} lost of {episodes}: signed rank p = {rank:.4f}, exact p = {exact:.4f}")
    return rank, exact

rank, exact = both(8, 1)
assert rank < 0.02 < 0.039 < exact
rank, exact = both(4, 0)
assert rank < 0.05 and exact == 0.125
assert math.isnan(both(0, 0)[0])
EOF
