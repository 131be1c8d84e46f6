#!/usr/bin/env bash
# In MuJoCo since 3.12 a joint's type equals the enum member from the left and not from the right.
#
# Versions: mujoco 4.0.0, numpy 2.4.6 (3.11.0 was still equal both ways; 3.12.0 to 4.0.0 are not).
# Guess: `mjJNT_HINGE == model.jnt_type[i]` says what `model.jnt_type[i] == mjJNT_HINGE` says.
# What happens: numbers of the model's arrays are numpy's int32. With the number on the left it is True, with the member on the
#   left False, and so is `type in (member, ...)`, whose test asks the member first; a plain int is equal from both sides.
#   A lookup by `if joint_type in (HINGE, SLIDE)` then takes the other branch without a word.
#   gymnasium-robotics 1.4.2 asserts this way: its Fetch, Shadow hand and Kitchen environments cannot be made (an
#   AssertionError without a text), Adroit and the mazes go on. Its requirements let pip take 4.0.0.
# Hurts: all code that tells joints, geoms or objects apart by `in` or with the member first.
# Live with it: `int(model.jnt_type[i])`, or mujoco below 3.12.
# torchrl_sparse: not touched; it allows mujoco below 3.10 alone (robosuite 1.5.2 wants that too), extra `kitchen` included.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint type="hinge"/><geom size=".1"/></body></worldbody></mujoco>'
)
hinge, kind = mujoco.mjtJoint.mjJNT_HINGE, model.jnt_type[0]
found = {
    "number == member": bool(kind == hinge),
    "member == number": bool(hinge == kind),
    "number in (member,)": kind in (hinge,),
    "member == int(number)": bool(hinge == int(kind)),
}
print("mujoco", mujoco.__version__, type(kind).__name__, found)
assert list(found.values()) == [True, False, False, True]
EOF
