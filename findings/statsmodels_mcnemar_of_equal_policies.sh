#!/usr/bin/env bash
# McNemar's test says p = 0 of two policies that never differ.
#
# Versions: statsmodels 0.15.0.
# Guess: twenty paired episodes with the same outcome each give p = 1, or an error.
# What happens: `mcnemar(table, exact=False)` divides by the number of discordant pairs, warns of a division by zero, and returns
#   statistic inf and p-value 0.0. One discordant pair gives p = 1. The default, exact=True, says 1.0 for both.
# Hurts: automatic verdicts: the accelerator that changes nothing is reported as significantly different. Pairs without
#   a difference are the usual case for good accelerators.
# Live with it: the exact test, or an interval that keeps a width without discordant pairs (Tango's score interval).
# torchrl_sparse: right; Tango's interval, whose closed form without discordant pairs is +-z²/(n + z²).
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check statsmodels==0.15.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from statsmodels.stats.contingency_tables import mcnemar
for name, table in (("never differ", [[15, 0], [0, 5]]), ("differ once ", [[14, 1], [0, 5]])):
    for exact in (True, False):
        result = mcnemar(table, exact=exact)
        print(name, "exact" if exact else "chi2 ", "statistic", result.statistic, "p", result.pvalue)
        expected = 0.0 if name == "never differ" and not exact else 1.0
        assert result.pvalue == expected
EOF
