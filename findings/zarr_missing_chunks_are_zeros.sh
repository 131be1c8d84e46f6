#!/usr/bin/env bash
# An incomplete copy of a zarr data set reads as actions of zero.
#
# Versions: zarr 3.1.6, numpy 2.4.6.
# Guess: where files of an array are missing, reading raises.
# What happens: a chunk that is not there is a chunk of the fill value, in stores of either format. Shape, attributes and episode ends
#   are whole; ten rows of the hundred are zeros, without a word.
# Hurts: demonstrations in Diffusion Policy's layout after an interrupted copy or unpacking: zero is a valid action and a valid position,
#   and black is a picture; normaliser and policy are then fitted to them.
# Live with it: compare `nchunks_initialized` with `nchunks` of every array after a copy.
# torchrl_sparse: reads no zarr; its demonstrations are HDF5 files whose ends and sizes are checked, a cut one is refused.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 zarr==3.1.6
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import pathlib
import numpy as np, zarr

for version in (2, 3):
    root = zarr.open_group(f"demos{version}.zarr", mode="w", zarr_format=version)
    actions = root.create_array("data/action", shape=(100, 2), chunks=(10, 2), dtype="f4")
    actions[:] = np.random.default_rng(0).uniform(1, 2, (100, 2))
    lost = pathlib.Path(f"demos{version}.zarr/data/action") / ("3.0" if version == 2 else "c/3/0")
    lost.unlink()
    found = zarr.open_group(f"demos{version}.zarr", mode="r")["data/action"]
    zeros = int((found[:] == 0).all(1).sum())
    print(f"format {version}: without one file of ten {zeros} rows are zeros; {found.nchunks_initialized} of {found.nchunks} chunks are there")
    assert zeros == 10 and found.nchunks_initialized == 9 and found.nchunks == 10
EOF
