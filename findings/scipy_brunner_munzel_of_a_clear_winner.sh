#!/usr/bin/env bash
# Where one policy is faster in every single episode, the Brunner-Munzel test has no p-value.
#
# Versions: scipy 1.17.1, numpy 2.4.6.
# Guess: the clearest difference that there is has the smallest p.
# What happens: without overlap the variance of the ranks is 0, the statistic is infinite and p is NaN, with 20 episodes a side as
#   with 2,000. One episode that overlaps brings p = 1e-6 or less back. The Mann-Whitney test gives 7e-8 in both cases.
# Hurts: comparisons of times to success between an accelerated policy and a slow one: `p < 0.05` is False for NaN, so the
#   clearest winner of a table is reported as no difference.
# Live with it: test for NaN before comparing, or take `mannwhitneyu` or a permutation test.
# torchrl_sparse: takes neither; its intervals of time ratios are paired, and NaN survives no correction for several comparisons.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import math
import numpy as np
from scipy.stats import brunnermunzel, mannwhitneyu

slow, fast = np.arange(200.0, 220.0), np.arange(100.0, 120.0)
overlap = fast.copy()
overlap[0] = 205.5
for name, times in (("no overlap", fast), ("one episode overlaps", overlap)):
    print(f"{name}: Brunner-Munzel p = {brunnermunzel(times, slow).pvalue:.2g}, Mann-Whitney p = {mannwhitneyu(times, slow).pvalue:.2g}")
assert math.isnan(brunnermunzel(fast, slow).pvalue)
assert brunnermunzel(overlap, slow).pvalue < 1e-6
assert mannwhitneyu(fast, slow).pvalue < 1e-6
many = np.arange(2000.0)
assert math.isnan(brunnermunzel(many, many + 5000).pvalue)
EOF
