#!/usr/bin/env bash
# A video of 84-pixel cameras has 96 pixels, and what is thin in a picture has another colour.
#
# Versions: imageio 2.38.1 with imageio-ffmpeg and av 18.1.0, numpy 2.4.6.
# Guess: frames written as a video come back in their size, a few grey values off.
# What happens: the default plugin stretches 84 pixels to 96, the next multiple of 16, and says so on the log alone; the pyav plugin
#   keeps 84. Both halve the colours' resolution: a blue line of one pixel, (0, 0, 255) on grey, comes back with half its blue, an
#   error of 100 and more, while a flat background is exact to 1.
# Hurts: policies trained from video data sets and run on live cameras: another size, and markers, cables and thin edges of another
#   colour than the camera shows.
# Live with it: `macro_block_size=1` (or pyav) for the size; keep training pictures uncompressed, or encode live frames alike.
# torchrl_sparse: trains on pictures from HDF5 as rendered; videos are for people to look at, and are not read back.
set -eu
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
"${PYTHON:-python3}" -m venv "$dir/venv"
"$dir/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 imageio==2.38.1 imageio-ffmpeg==0.6.0 av==18.1.0
cd "$dir"
"$dir/venv/bin/python" -W ignore - <<'EOF'
import logging
import imageio.v3 as iio, numpy as np

logging.disable(logging.WARNING)
frames = np.full((20, 84, 84, 3), 90, np.uint8)
frames[:, 60] = (0, 0, 255)
iio.imwrite("default.mp4", frames, fps=20, plugin="FFMPEG")
iio.imwrite("pyav.mp4", frames, fps=20, plugin="pyav", codec="libx264")
default, pyav = iio.imread("default.mp4", plugin="FFMPEG"), iio.imread("pyav.mp4", plugin="pyav")
print("default plugin:", default.shape, "pyav:", pyav.shape)
assert default.shape == (20, 96, 96, 3) and pyav.shape == frames.shape
print("blue line of one pixel:", pyav[10, 60, 40], "background:", pyav[10, 5, 5])
assert int(pyav[10, 60, 40, 2]) < 155
assert np.abs(pyav[10, 5, 5].astype(int) - 90).max() <= 2
EOF
