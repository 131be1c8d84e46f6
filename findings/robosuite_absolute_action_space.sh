#!/usr/bin/env bash
# An absolute controller's action space does not hold the pose in which the hand stands.
#
# Versions: robosuite 1.5.2 (its dependency evdev wants a C compiler), mujoco 3.9.0.
# Guess: with `input_type: absolute`, `action_spec` has limits in metres and radians, or none.
# What happens: limits stay -1 and 1 in all seven numbers, while positions are metres in the world and rotations up to pi. A table
#   is 0.8 m high, so hands work at and above 1 m: the command to stay 10 cm above the start is (-0.09, 0.00, 1.12, 2.1, 2.1, 0.2, -1).
#   The controller takes it as it is. Clipped to the space, the hand ends 10 cm lower and turned.
# Hurts: policies with absolute actions under whatever clips or scales to the action space, as many wrappers and actors do.
# Live with it: keep the space out of it, or set limits of one's own.
# torchrl_sparse: right; the action spec of its absolute tasks has no bounds for poses, and a test holds it against the pose of the hand.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check robosuite==1.5.2 mujoco==3.9.0 numpy==1.26.4 opencv-python==4.11.0.86 scipy==1.17.1
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import logging
import numpy as np, robosuite
from robosuite.controllers import load_composite_controller_config
from scipy.spatial.transform import Rotation
logging.disable(logging.WARNING)
controller = load_composite_controller_config(robot="Panda")
controller["body_parts"]["right"].update(input_type="absolute", input_ref_frame="world")

def stay(clipped):
    env = robosuite.make("Lift", robots="Panda", controller_configs=controller, has_renderer=False,
                         has_offscreen_renderer=False, use_camera_obs=False, seed=0)
    seen = env.reset()
    goal = seen["robot0_eef_pos"] + [0, 0, 0.1]
    action = np.r_[goal, Rotation.from_quat(seen["robot0_eef_quat_site"]).as_rotvec(), -1]
    low, high = env.action_spec
    assert (low == -1).all() and (high == 1).all() and (np.abs(action) > 1).any()
    for _ in range(40):
        seen, *_ = env.step(np.clip(action, low, high) if clipped else action)
    print("clipped" if clipped else "as it is", action.round(2), "off by", (seen["robot0_eef_pos"] - goal).round(3))
    return np.linalg.norm(seen["robot0_eef_pos"] - goal)

assert stay(False) < 0.005
assert stay(True) > 0.05
EOF
