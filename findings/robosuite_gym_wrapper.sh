#!/usr/bin/env bash
# robosuite's Gymnasium wrapper takes a seed without effect and calls the end of time a terminal state.
#
# Versions: robosuite 1.5.2 (its dependency evdev wants a C compiler; its wrappers import h5py, which it does not install),
#   mujoco 3.9.0, gymnasium 1.4.0.
# Guess: `reset(seed=0)` twice gives the same start, and after `horizon` steps `truncated` is true.
# What happens: the wrapper seeds NumPy's global generator, while a task places objects with a generator of its own: two starts after
#   the same seed differ. After `horizon` steps `terminated` is true and `truncated` false, success or not.
# Hurts: paired evaluations that are not paired, and value functions that learn that time's end is the goal or a failure.
# Live with it: `robosuite.make(..., seed=0)` fixes an environment's sequence of starts; count steps yourself.
# torchrl_sparse: right; each of its episodes is fixed by one seed, and time's end is `truncated`.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check robosuite==1.5.2 mujoco==3.9.0 numpy==1.26.4 opencv-python==4.11.0.86 gymnasium==1.4.0 h5py==3.16.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import numpy as np, robosuite
from robosuite.wrappers import GymWrapper
options = dict(robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, horizon=5)
env = GymWrapper(robosuite.make("Lift", **options))
one, two = env.reset(seed=0)[0], env.reset(seed=0)[0]
print("reset(seed=0) twice, equal:", np.array_equal(one, two))
assert not np.array_equal(one, two)
one, two = (GymWrapper(robosuite.make("Lift", seed=0, **options)).reset()[0] for _ in range(2))
print("make(seed=0) twice, equal: ", np.array_equal(one, two))
assert np.array_equal(one, two)
env.reset()
for _ in range(5):
    _, _, terminated, truncated, _ = env.step(np.zeros(7))
print("after the horizon of 5 steps: terminated", terminated, "truncated", truncated)
assert terminated and not truncated
EOF
