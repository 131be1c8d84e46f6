#!/usr/bin/env bash
# The six numbers of a rotation are two columns in one library and two rows in the other.
#
# Versions: roma 1.8.0, torch 2.13.0.
# Guess: "6-D rotation" is one format: `roma.special_gramschmidt` of the six numbers of a policy's action is its rotation.
# What happens: the published diffusion policies' six numbers are the first two rows of the matrix (PyTorch3D's order), roma's
#   are its first two columns. Read as the other's, a rotation comes out transposed: turned the other way, by the same angle. A matrix of any
#   rotation passes every check, and of a turn by half both readings agree.
# Hurts: whoever puts absolute actions of a policy on a robot with another library's rotations: small turns hardly show it.
# Live with it: convert one known quarter turn about one axis, once, before anything moves.
# torchrl_sparse: right; rows as published, and a test of `rotations` converts a quarter turn.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 roma==1.8.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import math
import roma, torch

turn = roma.rotvec_to_rotmat(torch.tensor([0, 0, math.pi / 2]))
rows = turn[:2].flatten()  # as the published policies' actions have it
read = roma.special_gramschmidt(rows.view(2, 3).T)
right = torch.stack([*rows.view(2, 3), torch.linalg.cross(rows[:3], rows[3:])])
print("a quarter turn about z:", roma.rotmat_to_rotvec(right).numpy().round(3))
print("its rows as roma's two columns:", roma.rotmat_to_rotvec(read).numpy().round(3))
assert torch.allclose(right, turn, atol=1e-6)
assert torch.allclose(read, turn.T, atol=1e-6) and not torch.allclose(read, turn, atol=0.5)
EOF
