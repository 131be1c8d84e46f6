#!/usr/bin/env bash
# A score interval of two success rates fails at 0 of 20 against 5 of 20 and not at 20 against 15.
#
# Versions: statsmodels 0.15.0.
# Guess: success and failure are names; exchanging them mirrors the interval of a difference.
# What happens: `confint_proportions_2indep(method="score")` gives [0.058, 0.492] for 20/20 against 15/20, and raises
#   "The function value at x=-0.25 is NaN" for the mirrored 0/20 against 5/20; 0/20 against 0/20 and 20/20 against 20/20
#   raise too. Method "wald" answers [0, 0] for both without a word. "newcomb" is symmetric and always answers.
# Hurts: evaluations on hard tasks, where rates are 0 at first: a script that ran on easy ones stops, or shows no width.
# Live with it: count failures instead of successes and negate; or "newcomb".
# torchrl_sparse: compares paired episodes alone; its interval is mirrored exactly by exchanging the policies.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check statsmodels==0.15.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
from statsmodels.stats.proportion import confint_proportions_2indep

def interval(counts, method):
    try:
        return [round(float(v), 3) for v in confint_proportions_2indep(*counts, method=method, compare="diff")]
    except ValueError as error:
        return f"ValueError: {error}"

cases = ((20, 20, 15, 20), (0, 20, 5, 20), (0, 20, 0, 20), (20, 20, 20, 20))
found = {(c, m): interval(c, m) for c in cases for m in ("score", "wald", "newcomb")}
for (counts, method), value in found.items():
    print("{}/{} against {}/{}".format(*counts), method, value)
assert found[cases[0], "score"] == [0.058, 0.492]
assert all("NaN" in found[c, "score"] for c in cases[1:])
assert found[cases[2], "wald"] == found[cases[3], "wald"] == [0.0, 0.0]
assert found[cases[0], "newcomb"] == [-v for v in found[cases[1], "newcomb"]][::-1]
EOF
