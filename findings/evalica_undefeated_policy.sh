#!/usr/bin/env bash
# A ranking of policies in which the best one is undefeated makes all of them equal.
#
# Versions: evalica 0.4.2.
# Guess: a policy that wins 10 of 10 comparisons with b, which wins 5 of 5 with c, is ranked first by Bradley-Terry.
# What happens: the likeliest strengths do not exist (a's is infinite). `bradley_terry` returns the same strength, its tolerance,
#   for a, b and c after two iterations, and so does `newman`, far below its limit of 100; no error, no flag. A tolerance of 1e-9
#   gives 1e-9 for all. Counting wins and `pagerank` rank a, b, c. A draw of each pair makes the strengths finite.
# Hurts: leaderboards of robot policies from few pairwise comparisons, where a policy without a defeat is common.
# Live with it: check that every policy has won and lost (the graph of wins is strongly connected), or add a draw a pair.
# torchrl_sparse: ranks nothing by pairwise strengths; it compares each method with dense on the same seeds.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check evalica==0.4.2
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import evalica
from evalica import Winner
left, right = ["a"] * 10 + ["b"] * 5, ["b"] * 10 + ["c"] * 5
wins = [Winner.X] * 15
for tolerance in (1e-4, 1e-9):
    result = evalica.bradley_terry(left, right, wins, tolerance=tolerance)
    scores = {name: float(score) for name, score in result.scores.items()}
    print("bradley_terry, tolerance", tolerance, scores, "iterations", result.iterations)
    assert set(scores.values()) == {tolerance}
counts = {name: float(score) for name, score in evalica.counting(left, right, wins).scores.items()}
print("counting", counts)
assert counts == {"a": 10, "b": 5, "c": 0}
scores = evalica.bradley_terry(left + ["a", "b"], right + ["b", "c"], wins + [Winner.Draw] * 2).scores
print("with a draw of each pair", {name: round(float(score), 3) for name, score in scores.items()})
assert scores["a"] > scores["b"] > scores["c"]
EOF
