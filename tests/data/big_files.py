"""Demonstration files of any size, made in a moment: every chunk of pictures is the same compressed bytes.

As a script it reads one and prints its peak memory before and after, bytes.
"""

import resource
import sys
import zlib

import h5py
import numpy as np

from tests.fixtures.demonstrations import describe

SIZE = 84
CHUNK = 50
FRAME = np.arange(SIZE * SIZE * 3, dtype=np.uint32).astype(np.uint8).reshape(SIZE, SIZE, 3)


def write_big(path, demos, length):
    """``demos`` times ``length`` pictures `FRAME`, 21 kB each; ``length`` is a multiple of `CHUNK`."""
    chunk = zlib.compress(np.broadcast_to(FRAME, (CHUNK, *FRAME.shape)).tobytes(), 1)
    shape = (length, *FRAME.shape)
    with h5py.File(path, "w") as file:
        for index in range(demos):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = length
            demo["actions"] = np.full((length, 7), index, float)
            demo["obs/robot0_eef_pos"] = np.full((length, 3), index, float)
            images = demo.create_dataset(
                "obs/agentview_image", shape, np.uint8, chunks=(CHUNK, *FRAME.shape), compression="gzip"
            )
            for row in range(0, length, CHUNK):
                images.id.write_direct_chunk((row, 0, 0, 0), chunk)
        describe(file)
    return path


def peak_memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    from torchrl_sparse.data.robomimic import read_demos

    before = peak_memory()
    cameras = {"image": "agentview_image"}
    demos = read_demos(sys.argv[1], ["robot0_eef_pos"], cameras=cameras, image_folder=sys.argv[2])
    last = demos.data["observation", "image"][-1].permute(1, 2, 0)
    assert (np.asarray(last) == FRAME).all()
    print(before, peak_memory(), demos.data["observation", "image"].numel())
