#!/usr/bin/env bash
# The variance beside a restricted mean time is that of single episodes, and the mean goes on beyond the last episode's end.
#
# Versions: lifelines 0.30.3, numpy 2.4.6.
# Guess: `restricted_mean_survival_time(..., return_variance=True)` gives the variance of the estimate, which falls with more
#   episodes; a restriction beyond the data's horizon is refused.
# What happens: it gives the variance of the time of one episode, 13,000 steps squared with 20 episodes as with 2,000. Its root taken for a
#   standard error is too wide by the root of the number of episodes. And of episodes that all stop at 400 steps, 30 % of them
#   unsolved, the mean restricted at 1,000 is given: unsolved ones are carried to 1,000, as if it had been seen that they fail.
# Hurts: comparisons of time to success: with that error bar nothing differs from anything; means of different horizons look alike.
# Live with it: divide by the number of episodes where none is censored before the horizon, else bootstrap; restrict at the horizon.
# torchrl_sparse: right; its intervals are of paired mean times, failures counted as the horizon, and narrow with more episodes.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 lifelines==0.30.3
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import numpy as np
from lifelines import KaplanMeierFitter
from lifelines.utils import restricted_mean_survival_time

for episodes in (20, 2000):
    draw = np.random.default_rng(0)
    times, solved = draw.integers(50, 400, episodes).astype(float), draw.random(episodes) < 0.7
    times[~solved] = 400
    curve = KaplanMeierFitter().fit(times, solved)
    mean, variance = restricted_mean_survival_time(curve, t=400, return_variance=True)
    beyond = restricted_mean_survival_time(curve, t=1000)
    print(f"{episodes} episodes: mean {mean:.1f} (of the times {times.mean():.1f}), variance {variance:.0f}")
    print(f"  variance of the times {times.var():.0f}, of their mean {times.var() / episodes:.1f}; restricted at 1000: {beyond:.1f}")
    assert abs(mean - times.mean()) < 1e-6
    assert abs(variance / times.var() - 1) < 0.01
    assert abs(beyond - (mean + 600 * (~solved).mean())) < 1e-6
EOF
