#!/usr/bin/env bash
# An interval for 0 successes of 20 that excludes 0, and one for 20 of 20 that excludes 1.
#
# Versions: statsmodels 0.15.0.
# Guess: every method of `proportion_confint` contains the rate that was seen.
# What happens: `method="jeffreys"` returns (2.4e-05, 0.117) for 0 of 20 and ends at 0.999976 for 20 of 20: the plain quantiles of
#   the posterior, without the customary correction at both ends. And `method="wilson"` ends at 0.9999999999999999 for 20
#   of 20, by rounding. `method="normal"` has no width at all there.
# Hurts: "does the interval contain the observed rate" and "rate above zero" as checks; plots whose point lies outside of its bar.
# Live with it: set the lower limit to 0 where nothing succeeded and the upper one to 1 where everything did.
# torchrl_sparse: right; `wilson_interval` sets both limits exactly, and says why.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check statsmodels==0.15.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from statsmodels.stats.proportion import proportion_confint
found = {m: (proportion_confint(0, 20, method=m), proportion_confint(20, 20, method=m)) for m in ("jeffreys", "wilson", "normal", "beta")}
for method, (none, every) in found.items():
    print(f"{method:9} 0 of 20: [{none[0]:.3g}, {none[1]:.3g}]  20 of 20: [{every[0]:.3g}, {every[1]!r}]")
assert found["jeffreys"][0][0] > 0 and found["jeffreys"][1][1] < 1
assert found["wilson"][1][1] < 1 and found["wilson"][1][1] > 1 - 1e-12
assert found["normal"][0] == (0, 0) and found["normal"][1] == (1, 1)
assert found["beta"][0][0] == 0 and found["beta"][1][1] == 1
EOF
